"""Updates of a fleet's belief by beacons, compiled by numba; without numba it is plain Python.

Arrays ``(J,)`` are by sensor, those of :class:`~shared.belief.fleet_belief.FleetBelief` and
:class:`~shared.belief.arrivals.Arrivals` of the same names. They are separate arguments, because building and passing a
tuple of them takes five times as long.
"""

import math

import numpy as np

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray


@compiled
def take_beacons(
    base: FloatArray,
    since: IntArray,
    heard: IntArray,
    battery: FloatArray,
    visited: IntArray,
    rate: FloatArray,
    capacity: float,
    ids: IntArray,
    beacon_step: IntArray,
    beacon_queue: FloatArray,
    beacon_battery: FloatArray,
    interval_ids: IntArray,
    came: FloatArray,
    steps: IntArray,
    at: IntArray,
) -> int:
    """Take n sensors' beacons that are newer than the known ones, as :meth:`FleetBelief.hear` does.

    Args:
        ids, beacon_step, beacon_queue, beacon_battery: the beacons, as that method has them.
        interval_ids, came, steps, at: shape ``(n,)``, are written: the sensors whose interval between two beacons shows
            arrivals, the packets that came, the interval's length, and the step in which it ended.

    Returns:
        the number of these intervals.
    """
    count = 0
    for n in range(ids.shape[0]):
        sensor, step, queue = ids[n], beacon_step[n], beacon_queue[n]
        if step <= heard[sensor]:
            continue
        passed = step - since[sensor]
        if heard[sensor] >= 0 and passed > 0 and queue < capacity:
            more, expected = queue - base[sensor], rate[sensor] * passed
            # After a visit that moved less than believed, the remaining packets are not arrivals.
            stayed = visited[sensor] == since[sensor] and more > expected + 4.0 * math.sqrt(expected) + 2.0
            if not stayed:
                interval_ids[count], came[count], steps[count], at[count] = sensor, max(more, 0.0), passed, step
                count += 1
        base[sensor], battery[sensor] = queue, beacon_battery[n]
        since[sensor] = heard[sensor] = step
    return count


@compiled
def in_range(places: FloatArray, east: float, north: float, radius: float, rows: IntArray, distance: FloatArray) -> int:
    """Find which of n sensors are within a radius of a UAV, metres; one of unknown position is not.

    Args:
        places: shape ``(n, 2)``, of these sensors.
        rows, distance: shape ``(n,)``, are written: the indices of those sensors, and their distances.

    Returns:
        their number.
    """
    count = 0
    for n in range(places.shape[0]):
        metres = np.hypot(places[n, 0] - east, places[n, 1] - north)
        if metres <= radius:
            rows[count], distance[count] = n, metres
            count += 1
    return count


@compiled
def take_arrivals(
    arrived: FloatArray,
    watched: FloatArray,
    rate: FloatArray,
    recent: FloatArray,
    recent_at: IntArray,
    ids: IntArray,
    came: FloatArray,
    steps: IntArray,
    at: IntArray,
    surprises: FloatArray,
) -> None:
    """Take the arrivals of n intervals, each of another sensor, as :meth:`Arrivals.take` does.

    Args:
        surprises: shape ``(n,)``, is written: the squared deviations from the expected arrivals, over their variances.
    """
    for n in range(ids.shape[0]):
        sensor = ids[n]
        expected = rate[sensor] * steps[n]
        # At least one packet's: with next to no expected arrivals, one packet is no burst.
        variance = max(expected + steps[n] * steps[n] * rate[sensor] / watched[sensor], 1.0)
        surprises[n] = (came[n] - expected) * (came[n] - expected) / variance
        recent[sensor], recent_at[sensor] = came[n] / steps[n], at[n]
        arrived[sensor] += came[n]
        watched[sensor] += steps[n]
        rate[sensor] = arrived[sensor] / watched[sensor]
