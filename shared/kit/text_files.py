"""Text files that people write, in whatever editor and on whatever system."""

import codecs
from collections.abc import Callable
from pathlib import Path


def text_of(path: Path, max_bytes: int, unusable: Callable[[str], Exception]) -> str:
    """The text of a UTF-8 file, with or without a byte order mark.

    Args:
        unusable: makes the error that is raised where the file cannot be read, is larger than ``max_bytes``, or is not
            UTF-8, from a text that names the file, the reason, and the line.
    """
    try:
        if path.exists() and not path.is_file():
            raise unusable(f"{path} is no file")
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise unusable(f"{path}: {error.strerror or error}") from None
    if len(content) > max_bytes:
        raise unusable(f"{path} is larger than {max_bytes // 1_000_000} MB; leave out what is not needed")
    if content.startswith(b"PK\x03\x04"):
        raise unusable(f"{path} is a ZIP archive, as KMZ and zipped shapefiles are; export it as a plain text file")
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise unusable(f"{path}, line {line}: not UTF-8; save the file as UTF-8") from None
