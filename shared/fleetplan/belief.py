"""A fleet's belief: the reports of all its UAVs merged, and rolled forward to the present step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.channel import FloatArray, IntArray, Links, packets_per_step
from shared.scenario import Point, Scenario
from shared.trajectory import Trajectory, progress_of, trajectories

# Sensors, by index.
Which = slice | list[int]
# A distance out of every reach.
FAR_M = 1e9
# A rate in packets a step that gives less than one packet in the longest mission, and the weight of its prior in steps.
_ZERO_RATE, _CERTAIN_STEPS = 1e-6, 1000.0
# The arrays of a belief.
_ARRAYS = ("arrived", "watched", "base", "since", "heard", "battery", "places", "visited")


@dataclass(slots=True)
class Whereabouts:
    """A UAV's position at the start of ``step``, and its decision in that step, if known.

    ``progress_m`` along its trajectory is ``None`` for a UAV off its trajectory, which is assumed to stay in place.
    """

    step: int
    position: Point
    progress_m: float | None
    action: tuple[int, int] | None = None


class FleetBelief:
    """The newest beacon of each sensor that any UAV heard, rolled forward, and the position of each UAV.

    A sensor never heard is assumed to have started with the mean of the scenario's initial queues.

    The rate of each sensor has a Gamma prior with the mean and variance of the scenario's range (uniform). The arrivals
    between successive beacons of queues that were not full update it.

    Attributes:
        places: shape ``(J, 2)``, metres; NaN for a sensor that no report has named.
        base: shape ``(J,)``, packets at the start of step ``since``, less the packets collected in that step.
        since: shape ``(J,)``, steps.
        heard: shape ``(J,)``, the step of the newest beacon, -1 for none.
        battery: shape ``(J,)``, joules.
        arrived, watched: shape ``(J,)``, the Gamma's shape and rate: packets, and the steps of their arrival.
        visited: shape ``(J,)``, the step of the last visit, if UAVs flew their decisions; -1 for none.
        uavs: by index, the UAVs that were ever located.
    """

    def __init__(self, scenario: Scenario) -> None:
        count, capacity, fewest = scenario.sensors, scenario.queue_capacity, scenario.initial_queue_min
        self._scenario = scenario
        self._paths = trajectories(scenario)
        self._drawn_variance = ((1 - fewest) * capacity) ** 2 / 12
        spread = (scenario.arrival_rate_max - scenario.arrival_rate_min) ** 2 / 12
        mean = scenario.mean_arrival_rate
        # A range without width makes the rate certain: its prior counts as very many steps. So does a rate of zero.
        prior_steps = mean / max(spread, 1e-3) if mean > _ZERO_RATE else _CERTAIN_STEPS
        self.arrived: FloatArray = np.full(count, mean * prior_steps)
        self.watched: FloatArray = np.full(count, prior_steps)
        self.base: FloatArray = np.full(count, (1 + fewest) / 2 * capacity)
        self.since: IntArray = np.zeros(count, dtype=np.int64)
        self.heard: IntArray = np.full(count, -1)
        self.battery: FloatArray = np.full(count, scenario.battery_j)
        self.places: FloatArray = np.full((count, 2), np.nan)
        self.visited: IntArray = np.full(count, -1)
        self.uavs: dict[int, Whereabouts] = {}

    @property
    def rate(self) -> FloatArray:
        """Expected packets a step, shape ``(J,)``."""
        return self.arrived / self.watched

    @property
    def newest(self) -> int | None:
        """The newest step in which a UAV was located, ``None`` before the first."""
        return max((last.step for last in self.uavs.values()), default=None)

    @property
    def base_variance(self) -> FloatArray:
        """The variance of ``base``, shape ``(J,)``: 0 for a sensor that was heard."""
        return np.where(self.heard < 0, self._drawn_variance, 0.0)

    def hear(self, ids: IntArray, places: FloatArray, beacon: IntArray, queue: FloatArray, battery: FloatArray) -> None:
        """Take the beacons that are newer than the known ones.

        Args:
            ids: shape ``(n,)``, the reported sensors, each once.
            places: shape ``(n, 2)``, metres.
            beacon: shape ``(n,)``, the step of the last beacon, -1 for none.
            queue: shape ``(n,)``, packets at the start of that step.
            battery: shape ``(n,)``, joules.
        """
        self.places[ids] = places
        newer = beacon > self.heard[ids]
        known, base, since = self.heard[ids] >= 0, self.base[ids], self.since[ids]
        counted = newer & known & (beacon > since) & (queue < self._scenario.queue_capacity)
        self.arrived[ids] += np.where(counted, np.maximum(queue - base, 0.0), 0.0)
        self.watched[ids] += np.where(counted, beacon - since, 0)
        news = ids[newer]
        self.base[news], self.battery[news] = queue[newer], battery[newer]
        self.since[news] = self.heard[news] = beacon[newer]

    def locate(self, uav: int, step: int, position: Sequence[float], reported_m: float | None = None) -> None:
        """Set a UAV's position at the start of a step; ``reported_m`` is its own report of its progress, metres."""
        here = (float(position[0]), float(position[1]))
        self.uavs[uav] = Whereabouts(step, here, progress_of(self._paths[uav], here, reported_m))

    def tell(self, uav: int, step: int, sensor: int, velocity: int) -> None:
        """Note a UAV's decision for the step in which it was located; a decision for another step does not count."""
        if uav in self.uavs and self.uavs[uav].step == step:
            self.uavs[uav].action = sensor, velocity

    def advance(self, step: int) -> None:
        """Fly the decisions of the steps before this one: move the UAVs, and subtract the packets they collected."""
        flying = sorted(uav for uav, last in self.uavs.items() if last.step < step and last.action is not None)
        served = set[tuple[int, int]]()
        for uav in flying:
            last = self.uavs[uav]
            sensor, velocity = last.action or (0, 0)
            if last.progress_m is not None:
                last.progress_m += velocity * self._scenario.step_s
                x, y = self._paths[uav].at(last.progress_m)
                last.position = float(x), float(y)
            if (sensor, last.step) not in served and (packets := self._movable(last.position, sensor)):
                served.add((sensor, last.step))
                self.collect(sensor, packets, last.step)
            last.step, last.action = last.step + 1, None

    def _movable(self, position: Point, sensor: int) -> int:
        """Packets that a step can move from a sensor to a UAV at this position; 0 for a sensor of unknown position."""
        metres = np.hypot(*(position - self.places[sensor]))
        # Most sensors are out of radio range, and computing one transfer takes as long as computing many.
        return int(Links.at(metres, self._scenario).packets) if metres <= self._scenario.radio_radius_m else 0

    def collect(self, sensor: int, packets: int, step: int) -> None:
        """Subtract the packets that a UAV collects in a step."""
        self.base[sensor] = max(0.0, self.queue(step, [sensor])[0] - packets)
        self.since[sensor] = step
        self.visited[sensor] = max(int(self.visited[sensor]), step)

    def state_dict(self) -> dict[str, Any]:
        """The whole belief, as copies."""
        arrays = {name: getattr(self, name).copy() for name in _ARRAYS}
        uavs = {uav: [u.step, list(u.position), u.progress_m, u.action] for uav, u in self.uavs.items()}
        return {**arrays, "uavs": uavs}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a belief."""
        for name in _ARRAYS:
            setattr(self, name, state[name])
        self.uavs = {
            uav: Whereabouts(step, (x, y), progress_m, None if action is None else (action[0], action[1]))
            for uav, (step, (x, y), progress_m, action) in state["uavs"].items()
        }

    def queue(self, step: int, which: Which = slice(None)) -> FloatArray:
        """Expected packets at the start of a step, shape ``(J,)``, or of the sensors ``which``."""
        rate = self.arrived[which] / self.watched[which]
        return np.minimum(
            self.base[which] + rate * np.maximum(step - self.since[which], 0), float(self._scenario.queue_capacity)
        )

    def present(self, step: int) -> list[int]:
        """The UAVs located in this step or the one before."""
        return sorted(uav for uav, last in self.uavs.items() if step - 1 <= last.step <= step)

    def decided(self, step: int) -> dict[int, tuple[int, int]]:
        """The UAVs' decisions in this step: sensor and velocity by index."""
        return {uav: last.action for uav, last in self.uavs.items() if last.step == step and last.action is not None}

    def trajectory(self, uav: int) -> Trajectory:
        """The UAV's trajectory."""
        return self._paths[uav]

    def links(self, uav: int, metres: ArrayLike) -> NDArray[np.int64]:
        """Packets that a step can move to the UAV after it has flown ``metres`` ``(n,)`` on: shape ``(n, J)``."""
        return packets_per_step(self.distances(uav, metres), self._scenario)

    def distances(self, uav: int, metres: ArrayLike, which: Which = slice(None)) -> FloatArray:
        """Horizontal distances, metres, ``(n, J)``, after the UAV has flown ``metres`` ``(n,)`` on.

        ``which`` selects the sensors, by default all. A sensor of unknown position is far away.
        """
        flown = np.asarray(metres, dtype=np.float64)
        last = self.uavs[uav]
        if last.progress_m is None:
            ahead = np.broadcast_to(np.asarray(last.position), (len(flown), 2))
        else:
            ahead = self._paths[uav].at(last.progress_m + flown)
        offset = ahead[:, None, :] - self.places[which]
        metres_off: FloatArray = np.hypot(offset[..., 0], offset[..., 1])
        metres_off[np.isnan(metres_off)] = FAR_M
        return metres_off
