"""The embedded LLM's file: written in 8 bits, and made again where it is damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gguf import GGMLQuantizationType, GGUFReader, GGUFWriter
from gguf.quants import dequantize, quantize

from service.config.settings import Settings
from service.llm import model_file
from service.llm.model_file import (
    EMBEDDED_NAME,
    GGUF_NAME,
    ModelMissing,
    embedded_model,
    fetch_model,
    sha256,
    to_eight_bits,
)

Q4_1, Q8_0 = GGMLQuantizationType.Q4_1, GGMLQuantizationType.Q8_0


def written(path: Path) -> Path:
    """A GGUF file with a matrix of 4 bits, a vector of floats, and keys of several kinds."""
    rng = np.random.default_rng(0)
    writer = GGUFWriter(path, "llama")
    writer.add_block_count(2)
    writer.add_token_list(["a", "b"])
    writer.add_file_type(3)
    matrix = quantize(rng.normal(size=(8, 64)).astype(np.float32), Q4_1)
    writer.add_tensor("blk.0.ffn_up.weight", matrix, raw_shape=matrix.shape, raw_dtype=Q4_1)
    writer.add_tensor("output_norm.weight", rng.normal(size=64).astype(np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return path


def test_matrices_of_4_bits_are_written_in_8_and_all_else_stays(tmp_path: Path) -> None:
    source, target = written(tmp_path / "four.gguf"), tmp_path / "eight.gguf"
    to_eight_bits(source, target)
    before, after = GGUFReader(source), GGUFReader(target)
    assert [tensor.name for tensor in after.tensors] == ["blk.0.ffn_up.weight", "output_norm.weight"]
    (matrix, vector), (eight, same) = before.tensors, after.tensors
    assert (eight.tensor_type, same.tensor_type) == (Q8_0, vector.tensor_type)
    assert np.array_equal(same.data, vector.data)
    weights, again = dequantize(matrix.data, Q4_1), dequantize(eight.data, Q8_0)
    assert again.shape == (8, 64)
    assert 0 < np.abs(again - weights).mean() < 0.01 * np.abs(weights).mean()
    assert after.fields["general.file_type"].contents() == 7
    for key in ("general.architecture", "llama.block_count", "tokenizer.ggml.tokens"):
        assert after.fields[key].contents() == before.fields[key].contents()


def test_a_damaged_file_is_made_again_and_a_whole_one_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = written(tmp_path / GGUF_NAME)
    monkeypatch.setattr(model_file, "GGUF_SHA256", sha256(source))
    made = fetch_model(tmp_path)
    assert made == tmp_path / EMBEDDED_NAME
    whole, first = made.read_bytes(), made.stat().st_mtime_ns
    assert fetch_model(tmp_path).stat().st_mtime_ns == first
    made.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert fetch_model(tmp_path).read_bytes() == whole
    (tmp_path / f"{EMBEDDED_NAME}.sha256").write_bytes(b"\xff\xfe")
    assert fetch_model(tmp_path).read_bytes() == whole
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(
        [GGUF_NAME, EMBEDDED_NAME, f"{EMBEDDED_NAME}.sha256"]
    )


def test_what_an_earlier_version_fetched_serves_where_the_new_file_is_not_there(tmp_path: Path) -> None:
    settings = Settings(cache_dir=tmp_path)
    with pytest.raises(ModelMissing, match="run `aicvds model fetch`"):
        embedded_model(settings)
    earlier = written(tmp_path / GGUF_NAME)
    assert embedded_model(settings) == earlier
    with pytest.raises(ModelMissing, match="check AICVDS_LLM_GGUF"):
        embedded_model(Settings(cache_dir=tmp_path, llm_gguf=tmp_path / "own.gguf"))
    made = written(tmp_path / EMBEDDED_NAME)
    assert embedded_model(settings) == made
