"""Updates of the sensors' records by beacons, compiled by numba; without numba it is plain Python."""

from __future__ import annotations

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray


@compiled
def record_beacons(
    visits: IntArray,
    seen: IntArray,
    queue: FloatArray,
    arrivals: FloatArray,
    exposure: FloatArray,
    capacity: float,
    ids: IntArray,
    before: IntArray,
    beacon_step: IntArray,
    beacon_queue: FloatArray,
) -> None:
    """Take n sensors' beacons that are newer than the known ones, as :meth:`Records.hear` does.

    Args:
        visits, seen, queue, arrivals, exposure: shape ``(J,)``, the arrays of :class:`~shared.belief.records.Records`.
        ids, before: shape ``(n,)``, each sensor once, and their ``seen``.
        beacon_step, beacon_queue: shape ``(n,)``.
    """
    for n in range(ids.shape[0]):
        sensor = ids[n]
        if beacon_step[n] <= before[n]:
            continue
        undisturbed = before[n] >= 0 and visits[sensor] < before[n]
        if undisturbed and queue[sensor] <= beacon_queue[n] < capacity:
            arrivals[sensor] += beacon_queue[n] - queue[sensor]
            exposure[sensor] += beacon_step[n] - before[n]
        seen[sensor], queue[sensor] = beacon_step[n], beacon_queue[n]
