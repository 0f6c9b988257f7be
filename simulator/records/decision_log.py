"""``decisions.jsonl``: one line a decision, in order of step and UAV."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from pydantic import TypeAdapter

from simulator.records.decision import Decision
from simulator.records.json_lines import read_lines


class DecisionLog:
    """Appends decisions to a new file and flushes each one, so that a killed mission loses at most half a line.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open("w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()

    def append(self, decision: Decision) -> None:
        """Write one line."""
        self._file.write(decision.model_dump_json() + "\n")
        self._file.flush()

    def rewrite(self, decisions: Iterable[Decision]) -> None:
        """Replace the file's lines by these, after an interrupt that may have torn the last line."""
        self._file.seek(0)
        self._file.truncate()
        self._file.writelines(decision.model_dump_json() + "\n" for decision in decisions)
        self._file.flush()


def read_decisions(path: Path) -> list[Decision]:
    """The decisions of a ``decisions.jsonl``, without a last line that a crash cut off.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line before the last is no decision; the text names the line.
    """
    return read_lines(path, TypeAdapter(Decision))
