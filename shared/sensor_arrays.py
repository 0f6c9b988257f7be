"""The columns of a report as arrays, made once for all that read them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.schemas import SensorColumns

# What stands for a beacon's queue, battery, gain and step where there was none.
_NO_BEACON = np.array([[0.0], [0.0], [0.0], [-1.0]])
_KEPT = "arrays"


@dataclass(frozen=True, slots=True, eq=False)
class SensorArrays:
    """What a report says of n sensors; nothing may change the arrays.

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
    """The columns as arrays; they have to have positions, and no copy with other columns is made of them afterwards."""
    # Beside the model's fields, as functools.cached_property would keep them: the wire's models are read without numpy.
    known: SensorArrays | None = sensors.__dict__.get(_KEPT)
    if known is None:
        known = sensors.__dict__[_KEPT] = _arrays(sensors)
    return known


def _arrays(sensors: SensorColumns) -> SensorArrays:
    ids = np.array(sensors.id, dtype=np.int64)
    places = np.array((sensors.x, sensors.y), dtype=np.float64).T
    # numpy converts None to NaN, and the wire admits no other NaN.
    beacons = (sensors.queue, sensors.battery, sensors.channel_gain, sensors.last_seen)
    values = np.array(beacons, dtype=np.float64)
    values = np.where(np.isnan(values), _NO_BEACON, values)
    steps = values[3].astype(np.int64)
    for array in (ids, places, values, steps):
        array.flags.writeable = False
    return SensorArrays(ids, places, values[0], values[1], values[2], steps)
