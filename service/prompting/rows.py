"""A sensor's row in the prompt: its columns, as comma-separated numbers."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.features.augmented_state import State
from shared.wire.schemas import Features

# The text of each column, by name: a whole number or UNKNOWN.
Cells = Mapping[str, str]

UNKNOWN = "?"
# Columns that are known without a beacon.
ALWAYS_KNOWN = ("sensor_id", "distance", "age")

# The columns of the paper's table of sensors, and those that preset `reach` adds: the heading and the meaning of each.
_PAPER_COLUMNS = {
    "sensor_id": ("SensorID", "the sensor"),
    "queue": ("Queue", "packets waiting"),
    "battery": ("BatteryLevel", "residual energy in J"),
    "gain": ("ChannelGain", "minus the path loss, in dB"),
    "distance": ("Distance", "metres from the UAV"),
    "age": ("TimeSinceLastVisit", "steps"),
    "urgency": ("UrgencyScore", "percent"),
    "overflow": ("OverflowProb", "probability of an overflow before the next visit, percent"),
}
_REACH_COLUMNS = {
    "best": ("BestVelocity", "the best velocity for it"),
    "movable": ("Collectable", "packets that can be collected at that velocity"),
}
# The static block's description of an experience.
EXPERIENCE_NOTE = (
    "Past experiences are the chosen sensor's row without its ID, then > sensor_id velocity: cost, where 0 is best."
)


def columns(features: Features) -> tuple[str, ...]:
    """Names of a row's columns, the sensor's ID first."""
    return tuple(_headings(features))


def introduction(features: Features) -> str:
    """The static block's names of a row's numbers, which the prefix cache then has, and their meanings."""
    found = _headings(features).values()
    meanings = "; ".join(f"{heading}: {meaning}" for heading, meaning in found)
    return f"{','.join(heading for heading, _ in found)}\n{meanings}."


def cells(state: State, rows: Sequence[int] | NDArray[np.int64]) -> list[dict[str, str]]:
    """The texts of these rows, in this order."""
    names, numbers = whole_numbers(state)
    return [
        dict(zip(names, map(str, row), strict=True)) for row in numbers.T[np.asarray(rows, dtype=np.int64)].tolist()
    ]


@lru_cache(maxsize=16)
def whole_numbers(state: State) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """The columns' names, and their numbers ``(columns, J)`` as they are written."""
    columns = full_columns(state)
    numbers = np.empty((len(columns), len(state.ids)))
    for row, column in zip(numbers, columns.values(), strict=True):
        np.rint(column, out=row)
    return tuple(columns), numbers.astype(np.int64)


def full_columns(state: State) -> dict[str, NDArray[Any]]:
    """Every sensor without pruning and masks, by column ``(J,)``.

    For a sensor that was never heard, only the columns of ``ALWAYS_KNOWN`` are meaningful.
    """
    columns: dict[str, NDArray[Any]] = {
        "sensor_id": state.ids,
        "queue": state.queue,
        "battery": state.battery,
        "gain": state.gain,
        "distance": state.distance,
        "age": state.since_visit,
        "urgency": 100.0 * state.urgency,
        "overflow": 100.0 * state.overflow,
    }
    if state.reach is not None:
        columns |= {"best": state.reach.best, "movable": state.reach.best_packets}
    return columns


def row(cells: Cells) -> str:
    """A sensor's line, such as ``3,52,48,-90,140,2,61,40``."""
    return ",".join(cells.values()) + "\n"


def experience(cells: Cells, answer: str, cost: str) -> str:
    """The line of a past decision, such as ``52,48,-90,140,2,61,40 > 3 9: 0.00``: a row without ID, answer, cost."""
    return f"{','.join(text for name, text in cells.items() if name != 'sensor_id')} > {answer}: {cost}\n"


def _headings(features: Features) -> dict[str, tuple[str, str]]:
    return _PAPER_COLUMNS if features == "paper" else _PAPER_COLUMNS | _REACH_COLUMNS
