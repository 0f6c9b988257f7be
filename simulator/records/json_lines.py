"""Reading a JSON Lines file whose last line may be cut off."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

Line = TypeVar("Line")


def read_lines(path: Path, line: TypeAdapter[Line]) -> list[Line]:
    """The lines of a JSON Lines file, without a last line that a crash cut off.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line before the last is invalid; the text names it.
    """
    lines = path.read_bytes().split(b"\n")
    parsed = []
    for number, text in enumerate(lines, start=1):
        if not text.strip():
            continue
        try:
            parsed.append(line.validate_json(text))
        except ValidationError as error:
            # Every whole line ends in a newline, so only the remainder after the last one may be torn.
            if number == len(lines):
                break
            raise ValueError(f"{path}, line {number}: {error.errors(include_url=False)[0]['msg']}") from None
    return parsed
