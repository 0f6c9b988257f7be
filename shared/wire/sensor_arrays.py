"""A report's columns as numpy's arrays."""

from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.wire.schemas import SensorColumns

_Numbers = NDArray[np.number[Any]]
_KEPT = "arrays"
# Queue, battery, gain and step of a missing beacon.
_NO_BEACON = np.array([[0.0], [0.0], [0.0], [-1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class SensorArrays:
    """A report's data of n sensors; the arrays are read-only.

    ``ids`` ``(n,)``; ``places`` ``(n, 2)``, m; ``queue`` packets, ``battery`` J and ``gain`` dB ``(n,)``, 0 for a
    sensor never heard; ``beacon`` ``(n,)``, the step of the last beacon, -1 for none.
    """

    ids: NDArray[np.int64]
    places: NDArray[np.float64]
    queue: NDArray[np.float64]
    battery: NDArray[np.float64]
    gain: NDArray[np.float64]
    beacon: NDArray[np.int64]


def arrays_of(sensors: SensorColumns) -> SensorArrays:
    """The columns as arrays. They need positions, and ``model_copy`` must not change them afterwards."""
    # Cached in the instance's __dict__, as functools.cached_property does: the wire's models do not import numpy.
    known: SensorArrays | None = sensors.__dict__.get(_KEPT)
    if known is None:
        known = sensors.__dict__[_KEPT] = _arrays(sensors)
    return known


def _arrays(sensors: SensorColumns) -> SensorArrays:
    count = len(sensors.id)
    ids = np.fromiter(sensors.id, np.int64, count)
    places = np.empty((count, 2))
    places[:, 0], places[:, 1] = np.fromiter(sensors.x, float, count), np.fromiter(sensors.y, float, count)
    # numpy converts None to NaN, and the wire admits no other NaN.
    beacons = chain(sensors.queue, sensors.battery, sensors.channel_gain, sensors.last_seen)
    values = np.fromiter(beacons, float, 4 * count).reshape(4, count)
    np.copyto(values, _NO_BEACON, where=np.isnan(values))
    steps = values[3].astype(np.int64)
    for array in (ids, places, values, steps):
        array.flags.writeable = False
    return SensorArrays(ids, places, values[0], values[1], values[2], steps)


def columns_of(ids: _Numbers, places: _Numbers, heard: _Numbers, beacon: _Numbers) -> dict[str, list[Any]]:
    """The columns of n sensors: ``places`` has shape ``(2, n)``, ``heard``, queue, battery and gain, ``(3, n)``."""
    rows = [np.where(beacon < 0, np.array(None), row.astype(object)) for row in (*heard, beacon)]
    names = ("id", "x", "y", "queue", "battery", "channel_gain", "last_seen")
    return {name: row.tolist() for name, row in zip(names, (ids, *places, *rows), strict=True)}
