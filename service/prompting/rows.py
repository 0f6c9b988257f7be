"""A sensor's row in the prompt: its columns, as comma-separated numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.features.augmented_state import State
from shared.wire.schemas import Features

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
_REACH_MEANINGS = {"best": "the best velocity for it", "movable": "packets that can be collected at that velocity"}
_NUMERALS = {5: "five", 7: "seven"}
# The static block's description of an experience.
EXPERIENCE_NOTE = (
    "Past decisions are rows without their first number, then > sensor_id velocity: cost, where 0 is best."
)


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


def introduction(names: tuple[str, ...], order: str) -> str:
    """The static block's description of a row, with the names of its numbers, which the prefix cache then has."""
    return f"Each row is one sensor, {order}, with {_NUMERALS[len(names)]} numbers:\n{','.join(names)}"


def row(cells: Cells) -> str:
    """A sensor's line, such as ``3,52,-90,2,140``."""
    return ",".join(cells.values()) + "\n"


def experience(cells: Cells, answer: str, cost: str) -> str:
    """The line of a past decision, such as ``52,-90,2,140 > 3 7: 0.0``: a row without its ID, the answer, its cost."""
    return f"{','.join(text for name, text in cells.items() if name != 'sensor_id')} > {answer}: {cost}\n"


def _meanings(features: Features) -> dict[str, str]:
    return _MEANINGS if features == "paper" else _MEANINGS | _REACH_MEANINGS
