"""``arrivals.csv``: the packets that arrived at each sensor in each step; ``gains.csv``: measured excess losses."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shared.world.channel import IntArray
from simulator.errors import UsageError
from simulator.sites.files.reading import quoted, text_of

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
    rows = csv.reader(io.StringIO(text_of(path, MAX_BYTES), newline=""), strict=True)
    steps: list[list[int]] = []
    try:
        order = _columns(path, [name.strip() for name in next(rows, [])], sensors)
        for row in rows:
            if not row:
                continue
            at = f"{path}, line {rows.line_num}"
            if len(row) != len(order) + 1:
                raise UsageError(f"{at}: {len(row)} values, the header has {len(order) + 1}")
            if row[0].strip() != str(len(steps)):
                raise UsageError(f"{at}: step {quoted(row[0])}, expected {len(steps)}; one line a step, counted from 0")
            if len(steps) == MAX_STEPS:
                raise UsageError(f"{at}: a mission has at most {MAX_STEPS:,} steps; cut the trace")
            steps.append([_packets(at, row[column], name) for name, column in zip(sensors, order, strict=True)])
    except csv.Error as error:
        raise UsageError(f"{path}, line {rows.line_num}: {error}") from None
    if not steps:
        raise UsageError(f"{path} has a header and no step; add one line a step")
    return np.array(steps, dtype=np.int64)


def _columns(path: Path, header: list[str], sensors: Sequence[str]) -> list[int]:
    """The index of each sensor's column."""
    at = f"{path}, line 1"
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
    count = cell.strip()
    if not re.fullmatch(r"[0-9]{1,7}", count) or int(count) > MAX_PACKETS:
        raise UsageError(
            f"{at}, column {quoted(sensor)}: {quoted(count)} packets; write a whole number from 0 to {MAX_PACKETS}"
        )
    return int(count)


def read_gains(path: Path, sensors: Sequence[str], lengths_m: Sequence[float]) -> GainTrace:
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
    rows = csv.reader(io.StringIO(text_of(path, MAX_BYTES), newline=""), strict=True)
    try:
        if [name.strip() for name in next(rows, [])] != HEADER:
            raise UsageError(f"{path}, line 1: the header is {','.join(HEADER)}")
        for count, row in enumerate(filter(None, rows)):
            at = f"{path}, line {rows.line_num}"
            if count == MAX_ROWS:
                raise UsageError(f"{at}: at most {MAX_ROWS:,} points; thin them out")
            if len(row) != len(HEADER):
                raise UsageError(f"{at}: {len(row)} values, the header has {len(HEADER)}")
            uav = _whole(at, row[0], len(lengths_m))
            if row[1].strip() not in column_of:
                raise UsageError(f"{at}: {quoted(row[1].strip())} is no sensor of world.geojson")
            along = _number(at, "progress_m", row[2], 0.0, lengths_m[uav])
            excess = _number(at, "excess_db", row[3], -MAX_EXCESS_DB, MAX_EXCESS_DB)
            of_pair = points.setdefault((uav, column_of[row[1].strip()]), {})
            if along in of_pair:
                raise UsageError(f"{at}: this point of UAV {uav} and sensor {quoted(row[1].strip())} comes twice")
            of_pair[along] = excess
    except csv.Error as error:
        raise UsageError(f"{path}, line {rows.line_num}: {error}") from None
    if not points:
        raise UsageError(f"{path} has a header and no point; add points, or take the file out")
    return GainTrace({pair: _sorted(of_pair) for pair, of_pair in sorted(points.items())})


def _sorted(of_pair: dict[float, float]) -> tuple[np.ndarray, np.ndarray]:
    along, excess = zip(*sorted(of_pair.items()), strict=True)
    return np.array(along), np.array(excess)


def _whole(at: str, cell: str, uavs: int) -> int:
    text = cell.strip()
    if not (text.isascii() and text.isdigit() and len(text) < 4 and int(text) < uavs):
        raise UsageError(f"{at}: UAV {quoted(text)}; write the number of a trajectory, 0 to {uavs - 1}")
    return int(text)


def _number(at: str, name: str, cell: str, least: float, most: float) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise UsageError(f"{at}: {name} {quoted(cell.strip())} is no number from {least:g} to {most:.2f}")
    return value
