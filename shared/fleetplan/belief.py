"""What a fleet knows together: every UAV's reports merged, and rolled forward to now."""

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
# Out of reach of everything.
FAR_M = 1e9
# Packets a step: less than one in the longest mission there may be; and the steps that its prior is worth.
_NOTHING, _CERTAIN_STEPS = 1e-6, 1000.0
# The arrays that make a belief.
_KEPT = ("arrived", "watched", "base", "since", "heard", "battery", "places", "visited")


@dataclass(slots=True)
class Whereabouts:
    """Where a UAV was at the start of ``step``, and what it was told to do then.

    ``progress_m`` along its trajectory is ``None`` for one that is off it: such a UAV is taken to stay.
    """

    step: int
    position: Point
    progress_m: float | None
    told: tuple[int, int] | None = None


class FleetBelief:
    """The newest beacon of each sensor, whoever heard it, rolled forward, and where each UAV is.

    A sensor never heard is taken to have begun with the mean of the queues that the scenario draws from.

    The rate of each sensor has a Gamma prior of the scenario's mean and variance (of a uniform distribution over its
    range), and what came between successive beacons of queues that were not full makes it a posterior.

    Attributes:
        places: shape ``(J, 2)``, metres; NaN for a sensor that nobody has named.
        base: shape ``(J,)``, packets at the start of step ``since``, less what was collected in it.
        since: shape ``(J,)``, steps.
        heard: shape ``(J,)``, the step of the newest beacon, -1 for none.
        battery: shape ``(J,)``, joules.
        arrived, watched: shape ``(J,)``, the Gamma's shape and rate: packets, and the steps that they came in.
        visited: shape ``(J,)``, the step of the last visit, as far as UAVs did what they were told; -1 for none.
        uavs: by index, those that were ever located.
    """

    def __init__(self, scenario: Scenario) -> None:
        count, capacity, fewest = scenario.sensors, scenario.queue_capacity, scenario.initial_queue_min
        self._scenario = scenario
        self._paths = trajectories(scenario)
        self._drawn_variance = ((1 - fewest) * capacity) ** 2 / 12
        spread = (scenario.arrival_rate_max - scenario.arrival_rate_min) ** 2 / 12
        mean = scenario.mean_arrival_rate
        # A range of no width is known: a prior worth very many steps. So is a world in which nothing ever arrives.
        prior_steps = mean / max(spread, 1e-3) if mean > _NOTHING else _CERTAIN_STEPS
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
        """The newest step that a UAV was located in, ``None`` before the first."""
        return max((last.step for last in self.uavs.values()), default=None)

    @property
    def base_variance(self) -> FloatArray:
        """Of ``base``, shape ``(J,)``: 0 of what was heard."""
        return np.where(self.heard < 0, self._drawn_variance, 0.0)

    def hear(self, ids: IntArray, places: FloatArray, beacon: IntArray, queue: FloatArray, battery: FloatArray) -> None:
        """Take the beacons that are newer than what is known.

        Args:
            ids: shape ``(n,)``, the sensors reported, each once.
            places: shape ``(n, 2)``, metres.
            beacon: shape ``(n,)``, the step of the last beacon, -1 for none.
            queue: shape ``(n,)``, packets at the start of that step.
            battery: shape ``(n,)``, joules.
        """
        self.places[ids] = places
        newer = beacon > self.heard[ids]
        known, base, since = self.heard[ids] >= 0, self.base[ids], self.since[ids]
        told = newer & known & (beacon > since) & (queue < self._scenario.queue_capacity)
        self.arrived[ids] += np.where(told, np.maximum(queue - base, 0.0), 0.0)
        self.watched[ids] += np.where(told, beacon - since, 0)
        news = ids[newer]
        self.base[news], self.battery[news] = queue[newer], battery[newer]
        self.since[news] = self.heard[news] = beacon[newer]

    def locate(self, uav: int, step: int, position: Sequence[float], told_m: float | None = None) -> None:
        """A UAV is here at the start of a step; ``told_m`` is what it says of its progress, metres."""
        here = (float(position[0]), float(position[1]))
        self.uavs[uav] = Whereabouts(step, here, progress_of(self._paths[uav], here, told_m))

    def tell(self, uav: int, step: int, sensor: int, velocity: int) -> None:
        """A UAV was told what to do in the step in which it was located; another step's word is too late to count."""
        if uav in self.uavs and self.uavs[uav].step == step:
            self.uavs[uav].told = sensor, velocity

    def advance(self, step: int) -> None:
        """Take what was told in the steps before this one as flown: where the UAVs are now, and what they collected."""
        flying = sorted(uav for uav, last in self.uavs.items() if last.step < step and last.told is not None)
        served = set[tuple[int, int]]()
        for uav in flying:
            last = self.uavs[uav]
            sensor, velocity = last.told or (0, 0)
            if last.progress_m is not None:
                last.progress_m += velocity * self._scenario.step_s
                x, y = self._paths[uav].at(last.progress_m)
                last.position = float(x), float(y)
            if (sensor, last.step) not in served and (packets := self._movable(last.position, sensor)):
                served.add((sensor, last.step))
                self.collect(sensor, packets, last.step)
            last.step, last.told = last.step + 1, None

    def _movable(self, position: Point, sensor: int) -> int:
        """Packets that a step can move from a sensor to a UAV at this position; 0 of a sensor that nobody named."""
        metres = np.hypot(*(position - self.places[sensor]))
        # Most sensors are out of every reach, and what one transfer moves takes as long to reckon as what many do.
        return int(Links.at(metres, self._scenario).packets) if metres <= self._scenario.radio_radius_m else 0

    def collect(self, sensor: int, packets: int, step: int) -> None:
        """Subtract what a UAV collects in a step."""
        self.base[sensor] = max(0.0, self.queue(step, [sensor])[0] - packets)
        self.since[sensor] = step
        self.visited[sensor] = max(int(self.visited[sensor]), step)

    def state_dict(self) -> dict[str, Any]:
        """All that is believed, as copies."""
        arrays = {name: getattr(self, name).copy() for name in _KEPT}
        uavs = {uav: [u.step, list(u.position), u.progress_m, u.told] for uav, u in self.uavs.items()}
        return {**arrays, "uavs": uavs}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken."""
        for name in _KEPT:
            setattr(self, name, state[name])
        self.uavs = {
            uav: Whereabouts(step, (x, y), progress_m, None if told is None else (told[0], told[1]))
            for uav, (step, (x, y), progress_m, told) in state["uavs"].items()
        }

    def queue(self, step: int, which: Which = slice(None)) -> FloatArray:
        """Expected packets at the start of a step, shape ``(J,)``, or of these sensors."""
        rate = self.arrived[which] / self.watched[which]
        return np.minimum(
            self.base[which] + rate * np.maximum(step - self.since[which], 0), float(self._scenario.queue_capacity)
        )

    def present(self, step: int) -> list[int]:
        """The UAVs located in this step or the one before."""
        return sorted(uav for uav, last in self.uavs.items() if step - 1 <= last.step <= step)

    def decided(self, step: int) -> dict[int, tuple[int, int]]:
        """What UAVs were told in this step: by index, sensor and velocity."""
        return {uav: last.told for uav, last in self.uavs.items() if last.step == step and last.told is not None}

    def trajectory(self, uav: int) -> Trajectory:
        """The one that the UAV flies."""
        return self._paths[uav]

    def links(self, uav: int, metres: ArrayLike) -> NDArray[np.int64]:
        """Packets that a step can move from where the UAV is after flying so far ``(n,)``: shape ``(n, J)``."""
        return packets_per_step(self.distances(uav, metres), self._scenario)

    def distances(self, uav: int, metres: ArrayLike, which: Which = slice(None)) -> FloatArray:
        """Horizontal distances to all sensors, ``(n, J)`` metres, or to these, after flying so far ``(n,)``.

        A sensor that nobody has named is far.
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
