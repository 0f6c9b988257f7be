"""``arrivals.csv``: the packets that arrived at each sensor in each step; ``gains.csv``: measured excess losses."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shared.kit.text_files import text_of
from shared.world.channel import IntArray
from simulator.errors import UsageError
from simulator.sites.files.reading import quoted

# The world takes a second to import, and commands answer bad use without it.
if TYPE_CHECKING:
    from simulator.world.gain_trace import GainTrace

MAX_BYTES = 50_000_000
MAX_STEPS, MAX_PACKETS = 10_000, 1_000_000
MAX_ROWS, MAX_EXCESS_DB = 1_000_000, 200.0
HEADER = ["uav", "sensor", "progress_m", "excess_db"]


def read_trace(path: Path, sensors: Sequence[str]) -> IntArray:
    """The trace of a CSV file with the header ``step,<sensor ID>,<sensor ID>,...`` and one line a step, from step 0.

    Args:
        sensors: the sensors' IDs; the file's columns may come in another order.

    Returns:
        Packets, shape ``(steps of the file, J)``, columns in the order of ``sensors``.

    Raises:
        UsageError: the file cannot be read or is invalid; the text names the line.
    """
    lines = _lines(path)
    order = _columns(*next(lines), sensors)
    steps: list[list[int]] = []
    for at, row in lines:
        if row[0] != str(len(steps)):
            raise UsageError(f"{at}: step {quoted(row[0])}, expected {len(steps)}; one line a step, counted from 0")
        if len(steps) == MAX_STEPS:
            raise UsageError(f"{at}: a mission has at most {MAX_STEPS:,} steps; cut the trace")
        steps.append([_packets(at, row[column], name) for name, column in zip(sensors, order, strict=True)])
    if not steps:
        raise UsageError(f"{path} has a header and no step; add one line a step")
    return np.array(steps, dtype=np.int64)


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The header and each line that is not blank: the file and the line's number for messages, and the cells."""
    rows = csv.reader(io.StringIO(text_of(path, MAX_BYTES, UsageError), newline=""), strict=True)
    try:
        header = [cell.strip() for cell in next(rows, [])]
        yield f"{path}, line 1", header
        for row in filter(None, rows):
            at = f"{path}, line {rows.line_num}"
            if len(row) != len(header):
                raise UsageError(f"{at}: {len(row)} values, the header has {len(header)}")
            yield at, [cell.strip() for cell in row]
    except csv.Error as error:
        raise UsageError(f"{path}, line {rows.line_num}: {error}") from None


def _whole(cell: str, most: int) -> int | None:
    """A whole number from 0 to ``most``; None for other text."""
    return int(cell) if re.fullmatch(r"[0-9]{1,7}", cell) and int(cell) <= most else None


def _columns(at: str, header: list[str], sensors: Sequence[str]) -> list[int]:
    """The index of each sensor's column."""
    if not header or header[0] != "step":
        found = quoted(header[0]) if header else "nothing"
        raise UsageError(f"{at}: the first column is {found}; the header is step and the sensors' IDs, split by commas")
    column_of = {name: column for column, name in enumerate(header[1:], start=1)}
    expected = frozenset(sensors)
    for name in header[1:]:
        if name not in expected:
            raise UsageError(f"{at}: column {quoted(name)} is no sensor of world.geojson; take it out")
    if len(column_of) < len(header) - 1:
        twice = next(name for name in column_of if header.count(name) > 1)
        raise UsageError(f"{at}: column {quoted(twice)} comes twice; keep one of the two")
    for name in sensors:
        if name not in column_of:
            raise UsageError(f"{at}: sensor {quoted(name)} of world.geojson has no column; add it")
    return [column_of[name] for name in sensors]


def _packets(at: str, cell: str, sensor: str) -> int:
    if (packets := _whole(cell, MAX_PACKETS)) is None:
        wanted = f"write a whole number from 0 to {MAX_PACKETS}"
        raise UsageError(f"{at}, column {quoted(sensor)}: {quoted(cell)} packets; {wanted}")
    return packets


def read_gains(path: Path, sensors: Sequence[str], lengths_m: Sequence[float]) -> "GainTrace":
    """The gain trace of a CSV file with the header ``uav,sensor,progress_m,excess_db``, one line a point, in any order.

    Args:
        sensors: the sensors' IDs.
        lengths_m: of each UAV's trajectory, metres.

    Raises:
        UsageError: the file cannot be read or is invalid; the text names the line.
    """
    from simulator.world.gain_trace import GainTrace

    points: dict[tuple[int, int], dict[float, float]] = {}
    column_of = {name: column for column, name in enumerate(sensors)}
    lines = _lines(path)
    at, header = next(lines)
    if header != HEADER:
        raise UsageError(f"{at}: the header is {','.join(HEADER)}")
    for count, (at, (flown_by, sensor, progress, loss)) in enumerate(lines):
        if count == MAX_ROWS:
            raise UsageError(f"{at}: at most {MAX_ROWS:,} points; thin them out")
        uav = _whole(flown_by, len(lengths_m) - 1)
        if uav is None:
            trajectories = f"write the number of a trajectory, 0 to {len(lengths_m) - 1}"
            raise UsageError(f"{at}: UAV {quoted(flown_by)}; {trajectories}")
        if sensor not in column_of:
            raise UsageError(f"{at}: {quoted(sensor)} is no sensor of world.geojson")
        along = _number(at, "progress_m", progress, 0.0, lengths_m[uav])
        excess = _number(at, "excess_db", loss, -MAX_EXCESS_DB, MAX_EXCESS_DB)
        of_pair = points.setdefault((uav, column_of[sensor]), {})
        if along in of_pair:
            raise UsageError(f"{at}: this point of UAV {uav} and sensor {quoted(sensor)} comes twice")
        of_pair[along] = excess
    if not points:
        raise UsageError(f"{path} has a header and no point; add points, or take the file out")
    ordered = {pair: np.array(sorted(of_pair.items())).T for pair, of_pair in sorted(points.items())}
    return GainTrace({pair: (along, excess) for pair, (along, excess) in ordered.items()})


def _number(at: str, name: str, cell: str, least: float, most: float) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise UsageError(f"{at}: {name} {quoted(cell)} is no number from {least:g} to {most:.2f}")
    return value
