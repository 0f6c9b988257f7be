"""``decisions.jsonl``, one decision a line in order of step and UAV, and ``requests.jsonl``, for ``aicvds replay``.

The first line of the requests is the mission's spec with the edge's defaults resolved and its scenario in full. Each
further line is one ``POST /decide`` in the order sent. A request is the full report whatever the uplink, with the
outcome that it carried. The outcomes of the last decisions are in ``decisions.jsonl``.
"""

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Generic, Self, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from shared.wire.missions import MissionStatus
from shared.wire.schemas import DecideRequest, MissionSpec
from simulator.records.decision import Decision

Line = TypeVar("Line")
Entry = TypeVar("Entry", bound=BaseModel)


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


class _Log(Generic[Entry]):
    """A new file of JSON lines; raises ``OSError`` if it cannot be written."""

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open("w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()

    def append(self, entry: Entry) -> None:
        """Write one line."""
        self._file.write(entry.model_dump_json() + "\n")
        self._file.flush()


class DecisionLog(_Log[Decision]):
    """Appends decisions to a new file and flushes each one, so that a killed mission loses at most half a line.

    Raises:
        OSError: the file cannot be written.
    """

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


_LINE: TypeAdapter[MissionSpec | DecideRequest] = TypeAdapter(MissionSpec | DecideRequest)


class RequestLog(_Log[DecideRequest]):
    """Writes the spec, then each request when it is sent, and flushes each line.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, spec: MissionSpec) -> None:
        super().__init__(path)
        self._file.write(spec.model_dump_json() + "\n")


def with_edge_defaults(spec: MissionSpec, status: MissionStatus) -> MissionSpec:
    """The spec with the defaults of the edge that made the mission, independent of another edge's defaults."""
    given = ("mode", "top_k", "attention", "prompt", "features", "belief", "verify", "planner", "init")
    return spec.model_copy(update={name: getattr(status, name) for name in given})


def read_requests(path: Path) -> tuple[MissionSpec, list[DecideRequest]]:
    """The spec and the requests, without a last line that a crash cut off.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is invalid; the text names it.
    """
    lines = read_lines(path, _LINE)
    if not lines or not isinstance(spec := lines[0], MissionSpec):
        raise ValueError(f"{path}, line 1: the mission's spec is missing")
    requests = [line for line in lines[1:] if isinstance(line, DecideRequest)]
    if len(requests) < len(lines) - 1:
        raise ValueError(f"{path}: there is more than one spec")
    return spec, requests
