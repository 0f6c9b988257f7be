"""Reading one of a world's files, of a bounded size."""

import codecs
from pathlib import Path

from simulator.errors import UsageError


def text_of(path: Path, max_bytes: int) -> str:
    """The text of a UTF-8 file, with or without a byte order mark.

    Raises:
        UsageError: the file cannot be read, is larger than ``max_bytes``, or is not UTF-8 (the text names the line).
    """
    try:
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is no file")
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    if len(content) > max_bytes:
        raise UsageError(f"{path} is larger than {max_bytes // 1_000_000} MB; leave out what the world does not need")
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UsageError(f"{path}, line {line}: not UTF-8; save the file as UTF-8") from None


def quoted(value: object) -> str:
    """A value of a file for a message: quoted, on one line, cut to the length of a name."""
    text = repr(value)
    return text if len(text) <= 48 else f"{text[:45]}..."
