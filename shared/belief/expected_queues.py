"""Queues and bursts that a fleet expects, compiled by numba; without numba it is plain Python.

Arrays ``(J,)`` are by sensor, those of :class:`~shared.belief.fleet_belief.FleetBelief` and
:class:`~shared.belief.arrivals.Arrivals` of the same names; ``powers`` are those of ``GOES_ON`` until they are 0.
"""

from __future__ import annotations

from shared.kit.compiled import compiled, inlined
from shared.world.channel import FloatArray, IntArray

# The probability that a burst lasts into the next step, and its powers until they are 0.
GOES_ON = 0.7


@inlined
def _still_to_come(
    rate: FloatArray, recent: FloatArray, recent_at: IntArray, powers: FloatArray, sensor: int, step: int
) -> float:
    """Expected further packets above the rate from a sensor's burst, from this step on."""
    at = recent_at[sensor]
    if at < 0:
        return 0.0
    steps = max(step - at, 0) + 1
    return float(max(recent[sensor] - rate[sensor], 0.0) * powers[min(steps, powers.shape[0] - 1)] / (1.0 - GOES_ON))


@compiled
def bursts_to_come(
    rate: FloatArray,
    recent: FloatArray,
    recent_at: IntArray,
    powers: FloatArray,
    bursts: bool,
    ids: IntArray,
    step: int,
    packets: FloatArray,
) -> None:
    """Write the expected further packets above the rate from n sensors' bursts, from this step on.

    Args:
        bursts: whether arrivals come in bursts.
    """
    for n in range(ids.shape[0]):
        packets[n] = _still_to_come(rate, recent, recent_at, powers, ids[n], step) if bursts else 0.0


@compiled
def expected_queues(
    rate: FloatArray,
    recent: FloatArray,
    recent_at: IntArray,
    powers: FloatArray,
    bursts: bool,
    base: FloatArray,
    since: IntArray,
    ids: IntArray,
    capacity: float,
    step: int,
    queue: FloatArray,
) -> None:
    """Write the expected packets of n sensors at the start of a step.

    Args:
        bursts: whether arrivals come in bursts.
        base, since: shape ``(n,)``, of these sensors.
    """
    for n in range(ids.shape[0]):
        sensor = ids[n]
        came = rate[sensor] * max(step - since[n], 0)
        if bursts:
            then = _still_to_come(rate, recent, recent_at, powers, sensor, min(since[n], step))
            came = came + (then - _still_to_come(rate, recent, recent_at, powers, sensor, step))
        queue[n] = min(base[n] + came, capacity)
