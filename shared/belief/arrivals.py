"""A fleet's estimate of the arrivals at the sensors: rates, their uncertainty, and bursts."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario

# The probability that a burst lasts into the next step, and its powers until they are 0.
GOES_ON = 0.7
_POWERS: FloatArray = np.asarray(GOES_ON ** np.arange(2100), dtype=np.float64)
# A rate in packets a step that yields less than one packet in the longest mission, and the weight of its prior in
# steps.
_ZERO_RATE, _CERTAIN_STEPS = 1e-6, 1000.0
# The weight of the assumption that arrivals are Poisson, in intervals between beacons, and the least significant
# dispersion.
_POISSON_INTERVALS, _LEAST_DISPERSION = 20, 1.5
_ARRAYS = ("arrived", "watched", "recent", "recent_at")


class Arrivals:
    """Each sensor's arrivals.

    The rate of each sensor has a Gamma prior with the mean and variance of the scenario's range (uniform). The packets
    that come between successive beacons of queues that are not full update it. If they vary more than Poisson arrivals
    with these rates, arrivals come in bursts, and a sensor with recent arrivals above its rate is expected to receive
    more.

    Attributes:
        arrived, watched: shape ``(J,)``, the Gamma's shape and rate: packets, and the steps of their arrival.
        rate: shape ``(J,)``, expected packets a step, ``arrived / watched``.
        dispersion: the variance of arrivals over a Poisson's, at least 1; 1 until many intervals show that it is more.
        recent: shape ``(J,)``, packets a step in the last interval, which ended in step ``recent_at``, -1 for none.
    """

    def __init__(self, scenario: Scenario) -> None:
        count, mean = scenario.sensors, scenario.mean_arrival_rate
        spread = (scenario.arrival_rate_max - scenario.arrival_rate_min) ** 2 / 12
        # A range without width makes the rate certain: its prior counts as very many steps. So does a rate of zero.
        prior_steps = mean / max(spread, mean / _CERTAIN_STEPS) if mean > _ZERO_RATE else _CERTAIN_STEPS
        self.arrived: FloatArray = np.full(count, mean * prior_steps)
        self.watched: FloatArray = np.full(count, prior_steps)
        self.rate: FloatArray = self.arrived / self.watched
        self.recent: FloatArray = np.zeros(count)
        self.recent_at: IntArray = np.full(count, -1)
        self._surprise, self._intervals = 0.0, 0
        self.dispersion = 1.0

    def take(self, ids: IntArray, came: FloatArray, steps: IntArray, at: IntArray) -> None:
        """Add arrivals ``(n,)``, packets, at sensors ``(n,)``, each once, over ``steps`` steps up to step ``at``."""
        surprises = np.empty(len(ids))
        arrays = self.arrived, self.watched, self.rate, self.recent, self.recent_at
        take_arrivals(*arrays, ids, came, steps, at, surprises)
        self._surprise += float(np.add.reduce(surprises))
        self._intervals += len(ids)
        self._estimate_dispersion()

    def _estimate_dispersion(self) -> None:
        found = (_POISSON_INTERVALS + self._surprise) / (_POISSON_INTERVALS + self._intervals)
        self.dispersion = found if found > _LEAST_DISPERSION else 1.0

    @property
    def in_bursts(self) -> bool:
        """Whether arrivals come in bursts."""
        return self.dispersion > 1.0

    def burst(self, step: int, ids: IntArray | None = None) -> FloatArray:
        """Expected further packets above the rate from the observed bursts, from this step on, ``(J,)`` or ``(n,)``."""
        which = slice(None) if ids is None else ids
        above = np.maximum(self.recent[which] - self.rate[which], 0.0)
        return _still_to_come(above, step - self.recent_at[which]) if self.in_bursts else np.zeros_like(above)

    def since(self, steps: IntArray, step: int, which: slice | IntArray) -> FloatArray:
        """Expected arrivals of sensors ``(n,)`` from ``steps`` ``(n,)`` to a step, packets."""
        rate = self.rate[which]
        came = rate * np.maximum(step - steps, 0)
        if self.in_bursts and (above := np.maximum(self.recent[which] - rate, 0.0)).any():
            at = self.recent_at[which]
            came += _still_to_come(above, np.minimum(steps, step) - at) - _still_to_come(above, step - at)
        return came

    def coming(self, step: int, horizon: float, ids: IntArray) -> FloatArray:
        """Expected arrivals of sensors ``(n,)`` from this step to the horizon, packets a step."""
        rate = self.rate[ids]
        if not self.in_bursts:
            return rate
        return rate + self.burst(step, ids) * float(self.burst_over(horizon)) / horizon

    @staticmethod
    def burst_over(steps: ArrayLike) -> FloatArray:
        """The share of a burst's further packets that arrive in the next steps ``(n,)``."""
        return np.asarray(1.0 - GOES_ON ** np.asarray(steps, dtype=np.float64))

    def state_dict(self) -> dict[str, Any]:
        """The arrivals, as copies."""
        arrays = {name: getattr(self, name).copy() for name in _ARRAYS}
        return {**arrays, "surprise": self._surprise, "intervals": self._intervals}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a ``state_dict``."""
        for name in _ARRAYS:
            setattr(self, name, state[name])
        self.rate = self.arrived / self.watched
        self._surprise, self._intervals = state["surprise"], state["intervals"]
        self._estimate_dispersion()


def _still_to_come(above: FloatArray, passed: IntArray) -> FloatArray:
    """A burst's further packets that many steps after an interval with ``above`` packets a step above the rate."""
    return np.asarray(above * _POWERS[np.minimum(np.maximum(passed, 0) + 1, len(_POWERS) - 1)] / (1.0 - GOES_ON))


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
        # The queue of a step before the visit from which it is known says less than that visit.
        if step <= heard[sensor] or step <= visited[sensor] == since[sensor]:
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
