"""A LoRA adapter as a GGUF file, which llama.cpp applies to the embedded model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import gguf
import numpy as np
from numpy.typing import NDArray

from service.llm.adapter_version import Version

# The model's matrices: transformers' names, and llama.cpp's.
_NAMES = {
    "self_attn.q_proj": "attn_q",
    "self_attn.k_proj": "attn_k",
    "self_attn.v_proj": "attn_v",
    "self_attn.o_proj": "attn_output",
    "mlp.gate_proj": "ffn_gate",
    "mlp.up_proj": "ffn_up",
    "mlp.down_proj": "ffn_down",
}
_HALVES = {"lora_A": "lora_a", "lora_B": "lora_b"}
_ALPHA = "adapter.lora.alpha"


@dataclass(frozen=True)
class GgufAdapter:
    """A LoRA adapter that :func:`write_gguf_adapter` wrote, in its 16 bits.

    Attributes:
        tensors: by llama.cpp's name, A ``(r, in)`` and B ``(out, r)``.
        alpha: the adapter adds ``alpha / r B A`` to each matrix.
    """

    tensors: dict[str, NDArray[np.float32]]
    alpha: float

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is no LoRA adapter.
        """
        try:
            reader = gguf.GGUFReader(path)
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path} is no GGUF file: {error}") from None
        alpha = reader.get_field(_ALPHA)
        if alpha is None or not any(tensor.name.endswith("lora_a") for tensor in reader.tensors):
            raise ValueError(f"{path} is no LoRA adapter")
        tensors = {tensor.name: np.asarray(tensor.data, dtype=np.float32) for tensor in reader.tensors}
        return cls(tensors, float(alpha.contents()))

    @property
    def rank(self) -> int:
        """``r``."""
        return next(len(values) for name, values in self.tensors.items() if name.endswith("lora_a"))

    def weights(self, heads: int, kv_heads: int) -> dict[str, NDArray[np.float32]]:
        """By peft's name, A and B, for a model with so many attention heads.

        Raises:
            ValueError: the adapter is none of a model of architecture ``llama``.
        """
        found = {}
        for ours, values in self.tensors.items():
            name = _peft_name(ours)
            if name.endswith(("q_proj.lora_B.weight", "k_proj.lora_B.weight")):
                values = _unpermuted(values, heads if "q_proj" in name else kv_heads)
            found[name] = values
        return found


def write_gguf_adapter(
    path: Path, weights: Mapping[str, NDArray[np.float32]], version: Version, *, alpha: float, heads: int, kv_heads: int
) -> None:
    """Write a LoRA adapter for a model of llama.cpp's architecture ``llama``.

    llama.cpp orders the rows of the query and key matrices differently from transformers, because of its rotary
    embedding: within a head, the second half's row i comes after the first half's row i. So the rows of these matrices'
    B are permuted.

    Args:
        weights: by peft's name, such as ``base_model.model.model.layers.0.mlp.up_proj.lora_A.weight``: A ``(r, in)``
            and B ``(out, r)``.
        version: of the prompt that it was trained on.
        alpha: the adapter adds ``alpha / r B A`` to each matrix.
        heads, kv_heads: the model's attention heads.

    Raises:
        ValueError: a weight's name is unknown.
    """
    writer = gguf.GGUFWriter(path, "llama")
    writer.add_string("general.type", "adapter")
    writer.add_string("adapter.type", "lora")
    writer.add_float32(_ALPHA, alpha)
    writer.add_uint32(version.key, version.number)
    for name, values in weights.items():
        target, half = _target(name)
        if half == "lora_b" and target.endswith(("attn_q.weight", "attn_k.weight")):
            values = _permuted(values, heads if "attn_q" in target else kv_heads)
        writer.add_tensor(f"{target}.{half}", np.ascontiguousarray(values.astype(np.float16)))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def _peft_name(name: str) -> str:
    """peft's name of a tensor, from llama.cpp's name."""
    block, _, rest = name.partition(".")[2].partition(".")
    for matrix, gguf_matrix in _NAMES.items():
        for part, half in _HALVES.items():
            if rest == f"{gguf_matrix}.weight.{half}":
                return f"base_model.model.model.layers.{block}.{matrix}.{part}.weight"
    raise ValueError(f"{name} is no adapter weight of a model of architecture llama")


def _target(name: str) -> tuple[str, str]:
    """llama.cpp's name of the matrix, and the half of the adapter."""
    _, _, within = name.partition("layers.")
    layer, _, rest = within.partition(".")
    for matrix, gguf_matrix in _NAMES.items():
        for part, half in _HALVES.items():
            if rest.startswith(f"{matrix}.{part}"):
                return f"blk.{layer}.{gguf_matrix}.weight", half
    raise ValueError(f"{name} is no adapter weight of a model of architecture llama")


def _permuted(rows: NDArray[np.float32], heads: int) -> NDArray[np.float32]:
    """Transformers' rows in llama.cpp's order: of each head, the halves' first rows, then their second ones, and on."""
    return _transposed(rows, heads, 2)


def _unpermuted(rows: NDArray[np.float32], heads: int) -> NDArray[np.float32]:
    return _transposed(rows, heads, len(rows) // heads // 2)


def _transposed(rows: NDArray[np.float32], heads: int, groups: int) -> NDArray[np.float32]:
    """Within each head, rows ``(groups, n)`` as ``(n, groups)``."""
    parts = rows.reshape(heads, groups, -1, *rows.shape[1:])
    return np.asarray(parts.swapaxes(1, 2).reshape(rows.shape))
