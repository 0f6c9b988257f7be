"""A sensor's row in the prompt: its columns, written as CSV, as JSON or in a Markdown table."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.features.augmented_state import State
from shared.wire.schemas import Features, PromptFormat

# The text of each column, by name: a whole number or UNKNOWN.
Cells = Mapping[str, str]

UNKNOWN = "?"
# Columns that are known without a beacon.
ALWAYS_KNOWN = ("sensor_id", "age", "distance")

_MEANINGS = {
    "queue": "packets waiting",
    "gain": "channel gain in dB",
    "age": "steps since its last visit",
    "distance": "metres from this UAV",
}
_REACH_MEANINGS = {
    "best": "the best velocity for it",
    "movable": "packets that can be collected at that velocity",
}
_NUMERALS = {5: "five", 7: "seven"}


def columns(features: Features) -> tuple[str, ...]:
    """Names of a row's columns, the sensor's ID first."""
    return ("sensor_id", *_meanings(features))


def meanings(features: Features) -> str:
    """The meaning of each column, in one line."""
    return " ".join(f"{name}: {meaning}." for name, meaning in _meanings(features).items())


def cells(state: State, rows: Sequence[int] | NDArray[np.int64]) -> list[dict[str, str]]:
    """The texts of these rows, in this order.

    There is no battery column: the mask excludes a sensor that cannot send.
    """
    columns, which = _columns_of(state), np.asarray(rows, dtype=np.int64)
    texts = [[str(round(number)) for number in column[which].tolist()] for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*texts, strict=True)]


def full_columns(state: State) -> dict[str, NDArray[Any]]:
    """Every sensor without pruning and masks, by column ``(J,)``, with the battery.

    For a sensor that was never heard, only the columns of ``ALWAYS_KNOWN`` are meaningful.
    """
    known = _columns_of(state)
    return {"sensor_id": known["sensor_id"], "queue": known["queue"], "battery": state.battery, **known}


def _columns_of(state: State) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {
        "sensor_id": state.ids,
        "queue": state.queue,
        "gain": state.gain,
        "age": state.since_visit,
        "distance": state.distance,
    }
    if state.reach is not None:
        columns |= {"best": state.reach.best, "movable": state.reach.best_packets}
    return columns


class Format(ABC):
    """A format of rows; by default its rows need no header."""

    # The separator between the experiences and the rows.
    gap = ""
    # The static block's description of a row, before the names of its numbers, and the separator of those names.
    row_note: str
    between_names = ", "
    # The static block's description of an experience.
    experience_note: str

    def introduction(self, names: tuple[str, ...], order: str) -> str:
        """The static block's description of a row, with the names of its numbers."""
        note = self.row_note.format(order=order, count=_NUMERALS[len(names)])
        return f"{note}:\n{self.between_names.join(names)}"

    def header(self, names: Iterable[str]) -> str:
        """The header above the rows of every prompt; empty where the static block has it."""
        return ""

    def experience_header(self, names: tuple[str, ...]) -> str:
        """The header above the experiences."""
        return ""

    @abstractmethod
    def row(self, cells: Cells) -> str:
        """One sensor's line."""

    @abstractmethod
    def experience(self, cells: Cells, answer: str, cost: str) -> str:
        """The line of a past decision: the chosen sensor's row without its ID, the answer, and its cost."""


class Csv(Format):
    """Comma-separated numbers; the header is part of the static block, where it costs nothing after the first time."""

    row_note = "Each row is one sensor, {order}, with {count} numbers"
    between_names = ","
    experience_note = (
        "Past decisions are rows without their first number, then > sensor_id velocity: cost, where 0 is best."
    )

    def row(self, cells: Cells) -> str:
        """A line such as ``3,52,-90,2,140``."""
        return ",".join(cells.values()) + "\n"

    def experience(self, cells: Cells, answer: str, cost: str) -> str:
        """A line such as ``52,-90,2,140 > 3 7: 0.0``."""
        return f"{','.join(_without_id(cells).values())} > {answer}: {cost}\n"


class Json(Format):
    """JSON Lines: one object a line, so that experiences can grow by appending."""

    row_note = "Each line is one sensor, {order}, a JSON object with {count} numbers"
    experience_note = (
        "Past decisions are objects without sensor_id, but with the answer (sensor_id velocity) and its cost, "
        "where 0 is best."
    )

    def row(self, cells: Cells) -> str:
        """A line such as ``{"sensor_id":3,"queue":52,"gain":-90,"age":2,"distance":140}``."""
        return f"{_json(cells)}\n"

    def experience(self, cells: Cells, answer: str, cost: str) -> str:
        """A line such as ``{"queue":52,"gain":-90,"age":2,"distance":140,"answer":"3 7","cost":0.0}``."""
        return f'{_json(_without_id(cells))[:-1]},"answer":"{answer}","cost":{cost}}}\n'


class Markdown(Format):
    """A table, which needs its header above the rows of every prompt."""

    gap = "\n"
    row_note = "Each row of the table is one sensor, {order}, with {count} numbers"
    experience_note = (
        "Past decisions are a table without sensor_id, but with the answer (sensor_id velocity) and its cost, "
        "where 0 is best."
    )

    def header(self, names: Iterable[str]) -> str:
        """Two lines."""
        listed = list(names)
        return f"{_piped(listed)}{_piped(['---'] * len(listed))}"

    def experience_header(self, names: tuple[str, ...]) -> str:
        """Two lines."""
        return self.header((*names[1:], "answer", "cost"))

    def row(self, cells: Cells) -> str:
        """A line such as ``| 3 | 52 | -90 | 2 | 140 |``."""
        return _piped(cells.values())

    def experience(self, cells: Cells, answer: str, cost: str) -> str:
        """A line such as ``| 52 | -90 | 2 | 140 | 3 7 | 0.0 |``."""
        return _piped((*_without_id(cells).values(), answer, cost))


FORMATS: dict[PromptFormat, Format] = {"csv": Csv(), "json": Json(), "markdown": Markdown()}


def _meanings(features: Features) -> dict[str, str]:
    return _MEANINGS if features == "paper" else _MEANINGS | _REACH_MEANINGS


def _without_id(cells: Cells) -> dict[str, str]:
    return {name: text for name, text in cells.items() if name != "sensor_id"}


def _json(cells: Cells) -> str:
    numbers = {name: None if text == UNKNOWN else int(text) for name, text in cells.items()}
    return json.dumps(numbers, separators=(",", ":"))


def _piped(texts: Iterable[str]) -> str:
    return f"| {' | '.join(texts)} |\n"
