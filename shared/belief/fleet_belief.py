"""A fleet's belief: the reports of all its UAVs merged, and rolled forward to the present step."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import astuple, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from shared.belief.arrivals import Arrivals, in_range, take_beacons
from shared.belief.drift import Drift
from shared.belief.learned_channel import ExpectedLinks, LearnedChannel
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Point, Scenario
from shared.world.step_rule import least_joules_a_packet
from shared.world.trajectory import Trajectory, progress_of, trajectories

# A distance out of reach of every UAV.
FAR_M = 1e9
# A position farther than this from the reported progress has an error; then the place on the trajectory counts, metres.
_POSITION_ERROR_M = 0.01
# The arrays of a belief.
_ARRAYS = ("base", "since", "heard", "battery", "places", "visited")


@dataclass(frozen=True, eq=False)
class Measured:
    """The measurements of a report.

    Attributes:
        excess_db: shape ``(n,)``, excess losses of the sensors in radio range that were heard in this step, dB.
        radio_failed: whether the UAV's last transmission failed over a good link.
    """

    excess_db: FloatArray
    radio_failed: bool = False


NOTHING_MEASURED = Measured(np.zeros(0))


@dataclass(slots=True)
class Visit:
    """A flown decision: the sensor, the velocity, where the UAV started, and what was believed of the sensor before.

    ``collected`` says whether the belief has taken packets from the sensor, and ``failed`` is the UAV's report,
    ``None`` before it.
    """

    step: int
    sensor: int
    base: float
    since: int
    visited: int
    collected: bool
    failed: bool | None
    velocity: int
    start_m: float | None


@dataclass(slots=True)
class Whereabouts:
    """A UAV's position at the start of ``step``, its decision in that step, if known, and its last flown one.

    ``progress_m`` along its trajectory is ``None`` for a UAV off its trajectory, which is assumed to stay in place.
    ``failed`` is the reported outcome of ``action``, ``None`` before the report. ``taught`` is the step of the newest
    report from which channel and drift have learned: a repeated report is ignored.
    """

    step: int
    position: Point
    progress_m: float | None
    action: tuple[int, int] | None = None
    failed: bool | None = None
    visit: Visit | None = None
    taught: int = -1

    def ahead(self, path: Trajectory, drift: Drift, metres: ArrayLike) -> FloatArray:
        """The UAV's places, ``(n, 2)``, after it has flown ``metres`` ``(n,)`` on along its trajectory."""
        flown = np.asarray(metres, dtype=np.float64)
        if self.progress_m is None:
            return np.broadcast_to(np.asarray(self.position), (len(flown), 2))
        return path.at(self.progress_m + drift.flown(path, self.progress_m, flown))

    def state(self) -> list[Any]:
        """The attributes, as plain values."""
        visit = None if self.visit is None else astuple(self.visit)
        return [self.step, list(self.position), self.progress_m, self.action, self.failed, visit, self.taught]

    @classmethod
    def of(cls, state: Sequence[Any]) -> Self:
        """From such a state; one of an earlier version ends with the action."""
        step, (x, y), progress_m, action, failed, visit, taught = (*state, None, None, -1)[:7]
        seen = None if visit is None else Visit(*visit)
        return cls(step, (x, y), progress_m, None if action is None else (action[0], action[1]), failed, seen, taught)


class FleetBelief:
    """The newest beacon of each sensor that any UAV heard, rolled forward, and the position of each UAV.

    A sensor never heard is assumed to have started with the mean of the scenario's initial queues.

    Attributes:
        places: shape ``(J, 2)``, metres; NaN for a sensor that no report has named.
        base: shape ``(J,)``, packets at the start of step ``since``, less the packets collected in that step.
        since: shape ``(J,)``, steps; negative for a queue that was read before the mission's first step.
        heard: shape ``(J,)``, the step of the newest beacon, -1 for none.
        battery: shape ``(J,)``, joules; 0 for a sensor whose battery pays for no packet.
        visited: shape ``(J,)``, the step of the last visit, assuming that UAVs fly their decisions; -1 for none.
        uavs: by index, the UAVs that were ever located.
        arrivals, channel, drift: learned from queues, from gains and outcomes, and from the UAVs' progress.
    """

    def __init__(self, scenario: Scenario) -> None:
        count, capacity = scenario.sensors, scenario.queue_capacity
        fewest, most = scenario.initial_queue_min, scenario.initial_queue_max
        self._scenario = scenario
        self._paths, self._packet_j = trajectories(scenario), least_joules_a_packet(scenario)
        self._drawn_variance = ((most - fewest) * capacity) ** 2 / 12
        self.base: FloatArray = np.full(count, (most + fewest) / 2 * capacity)
        self.since: IntArray = np.zeros(count, dtype=np.int64)
        self.heard: IntArray = np.full(count, -1)
        self.battery: FloatArray = np.full(count, scenario.battery_j)
        self.places: FloatArray = np.full((count, 2), np.nan)
        self.visited: IntArray = np.full(count, -1)
        self.uavs: dict[int, Whereabouts] = {}
        self.arrivals = Arrivals(scenario)
        self.channel = LearnedChannel(scenario)
        self.drift = Drift()

    @property
    def newest(self) -> int | None:
        """The newest step in which a UAV was located, ``None`` before the first."""
        return max((last.step for last in self.uavs.values()), default=None)

    @property
    def base_variance(self) -> FloatArray:
        """The variance of ``base``, shape ``(J,)``: 0 for a sensor heard, visited, or read before the first step."""
        return np.where((self.heard < 0) & (self.visited < 0) & (self.since >= 0), self._drawn_variance, 0.0)

    def hear(self, ids: IntArray, places: FloatArray, beacon: IntArray, queue: FloatArray, battery: FloatArray) -> None:
        """Add the beacons that are newer than the known ones.

        Args:
            ids: shape ``(n,)``, the reported sensors, each once.
            places: shape ``(n, 2)``, metres.
            beacon: shape ``(n,)``, the step of the last beacon, -1 for none.
            queue: shape ``(n,)``, packets at the start of that step.
            battery: shape ``(n,)``, joules.
        """
        # numpy raises an error for an unknown sensor ID; compiled code would not.
        self.places[ids] = places
        if not len(ids) == len(beacon) == len(queue) == len(battery):
            raise ValueError(
                f"{len(ids)} sensors with {len(beacon)} beacons, {len(queue)} queues, {len(battery)} batteries"
            )
        # Copies, because numba would recompile the function for other types and for read-only arrays.
        heard = np.array(ids, dtype=np.int64), np.array(beacon, dtype=np.int64)
        values = np.array(queue, dtype=np.float64), np.where(battery < self._packet_j, 0.0, battery)
        (which, steps, at), came = np.empty((3, len(ids)), dtype=np.int64), np.empty(len(ids))
        known = self.base, self.since, self.heard, self.battery, self.visited, self.arrivals.rate
        count = take_beacons(*known, float(self._scenario.queue_capacity), *heard, *values, which, came, steps, at)
        if count:
            self.arrivals.take(which[:count], came[:count], steps[:count], at[:count])

    def begin(self, ids: IntArray, step: IntArray, queue: FloatArray, battery: FloatArray) -> None:
        """Set the queues ``(n,)`` of sensors ``(n,)`` in steps ``(n,)`` before the mission's first one."""
        self.base[ids], self.since[ids] = queue, step
        self.battery[ids] = np.where(battery < self._packet_j, 0.0, battery)

    def locate(self, uav: int, step: int, position: Sequence[float], reported_m: float | None = None) -> None:
        """Set a UAV's position at the start of a step; ``reported_m`` is its own report of its progress, metres."""
        here = (float(position[0]), float(position[1]))
        last = self.uavs.get(uav)
        visit, taught = (None, -1) if last is None else (last.visit, last.taught)
        path = self._paths[uav]
        progress = progress_of(path, here, reported_m)
        if reported_m is not None and progress == reported_m:
            x, y = path.at(reported_m).tolist()
            if math.hypot(x - here[0], y - here[1]) > _POSITION_ERROR_M:
                here = x, y
            # Only an outcome says that the UAV got the decision, and flew it.
            flown = visit if visit is not None and visit.step == step - 1 and visit.failed is not None else None
            if taught != step and flown is not None and flown.start_m is not None:
                self.drift.learn(path, flown.start_m, flown.velocity * self._scenario.step_s, reported_m)
        self.uavs[uav] = Whereabouts(step, here, progress, visit=visit, taught=taught)

    def measure(self, uav: int, ids: IntArray, gain_db: FloatArray) -> Measured:
        """Learn from the gains ``(n,)`` of the beacons that a UAV hears at its position.

        The transmission of the UAV's last step was over the same link as the beacon now. If it failed although that
        link is good, the sensor's radio failed.
        """
        last = self.uavs[uav]
        if last.taught == last.step:
            return NOTHING_MEASURED
        last.taught = last.step
        rows, distance = np.empty(len(ids), dtype=np.int64), np.empty(len(ids))
        count = in_range(self.places[ids], *last.position, self._scenario.radio_radius_m, rows, distance)
        rows, distance = rows[:count], distance[:count]
        near, gain_db = ids[rows], gain_db[rows]
        excess_db = self.channel.measure(near, last.position, distance, gain_db)
        visit = last.visit
        if visit is None or visit.failed is None or visit.step != last.step - 1:
            return Measured(excess_db)
        row = np.flatnonzero(near == visit.sensor)
        others = (other.visit for index, other in self.uavs.items() if index != uav)
        contested = any(o is not None and (o.sensor, o.step) == (visit.sensor, visit.step) for o in others)
        # A sensor serves one UAV in a step, even with a working radio.
        if not len(row) or contested:
            return Measured(excess_db)
        return Measured(excess_db, radio_failed=self._learn_of_visit(visit, -float(gain_db[row[0]])))

    def _learn_of_visit(self, visit: Visit, loss_db: float) -> bool:
        """Learn from a UAV's last visit over a link of this loss; returns whether the sensor's radio failed."""
        packet_j, packets = self.channel.transfer(loss_db)
        if self.battery[visit.sensor] < packet_j:
            return False
        failed = bool(visit.failed)
        radio_failed = self.channel.transmitted(visit.sensor, failed, loss_db)
        if not failed and visit.since == visit.step and self.since[visit.sensor] == visit.step + 1:
            # The queue was known before and after, which gives the packets moved.
            rate = float(self.arrivals.coming(visit.step, 1, np.array([visit.sensor]))[0])
            moved = visit.base + rate - float(self.base[visit.sensor])
            slack = 3.0 * math.sqrt(rate * self.arrivals.dispersion) + 1.0
            self.channel.moved(moved, visit.base, packets, slack)
        return radio_failed

    def record_decision(self, uav: int, step: int, sensor: int, velocity: int) -> None:
        """Record a UAV's decision for the step in which it was located; a decision for another step is ignored."""
        if uav in self.uavs and self.uavs[uav].step == step:
            self.uavs[uav].action, self.uavs[uav].failed = (sensor, velocity), None

    def settle(self, uav: int, step: int, failed: bool) -> None:
        """Apply the outcome of a UAV's decision of a step; only that of its last decision counts."""
        if uav not in self.uavs:
            return
        last = self.uavs[uav]
        if last.step == step and last.action is not None:
            last.failed = failed
            return
        visit = last.visit
        if visit is None or visit.step != step or visit.failed is not None:
            return
        visit.failed = failed
        if failed and visit.collected:
            if self.visited[visit.sensor] == step:
                self.visited[visit.sensor] = visit.visited
            if self.heard[visit.sensor] <= step and self.since[visit.sensor] == step:
                self.base[visit.sensor], self.since[visit.sensor] = visit.base, visit.since
        elif not failed and not visit.collected:
            place = self.places[visit.sensor]
            self.collect(visit.sensor, self.channel.packets(last.position, place, visit.sensor, held=True), step)

    def advance(self, step: int) -> None:
        """Fly the decisions of the steps before this one: move the UAVs, and subtract the packets they collected."""
        flying = sorted(uav for uav, last in self.uavs.items() if last.step < step and last.action is not None)
        visits = (last.visit for last in self.uavs.values())
        served = {(visit.sensor, visit.step) for visit in visits if visit is not None and visit.collected}
        for uav in flying:
            self._fly(uav, served)
        if step > self.channel.failures.step:
            self.channel.failures.advance(step)

    def _fly(self, uav: int, served: set[tuple[int, int]]) -> None:
        """Fly one UAV's decision; ``served`` has the sensors and steps of the fleet's successful visits."""
        last = self.uavs[uav]
        sensor, velocity = last.action or (0, 0)
        start = last.progress_m
        if start is not None:
            path, still_m = self._paths[uav], velocity * self._scenario.step_s
            last.progress_m = start + float(self.drift.flown(path, start, np.array([still_m]))[0])
            x, y = path.at(last.progress_m)
            last.position = float(x), float(y)
        base, since, visited = float(self.base[sensor]), int(self.since[sensor]), int(self.visited[sensor])
        collected = False
        if (sensor, last.step) not in served and not last.failed:
            held = last.failed is False
            packets = self.channel.packets(last.position, self.places[sensor], sensor, held=held)
            if collected := packets > 0:
                served.add((sensor, last.step))
                self.collect(sensor, packets, last.step)
        last.visit = Visit(last.step, sensor, base, since, visited, collected, last.failed, velocity, start)
        last.step, last.action, last.failed = last.step + 1, None, None

    def collect(self, sensor: int, packets: int, step: int) -> None:
        """Subtract the packets that a UAV collects in a step, unless the queue is known at a later step."""
        self.visited[sensor] = max(int(self.visited[sensor]), step)
        if self.since[sensor] > step:
            return
        self.base[sensor] = max(0.0, float(self.queue(step, np.array([sensor]))[0]) - packets)
        self.since[sensor] = step

    def copy(self) -> Self:
        """A copy for another thread, which later changes of this belief do not affect."""
        return deepcopy(self, {id(one): one for one in (self._scenario, self._paths)})

    def state_dict(self) -> dict[str, Any]:
        """The whole belief, as copies."""
        arrays = {name: getattr(self, name).copy() for name in _ARRAYS}
        uavs = {uav: last.state() for uav, last in self.uavs.items()}
        learned = {"channel": self.channel.state_dict(), "drift": self.drift.state_dict()}
        return {**arrays, **self.arrivals.state_dict(), "uavs": uavs, **learned}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        for name in _ARRAYS:
            setattr(self, name, state[name])
        self.arrivals.load_state_dict(state)
        self.uavs = {uav: Whereabouts.of(known) for uav, known in state["uavs"].items()}
        self.channel.load_state_dict(state["channel"])
        self.drift.load_state_dict(state["drift"])

    def queue(self, step: int, ids: IntArray | None = None) -> FloatArray:
        """Expected packets at the start of a step, shape ``(J,)``, or of the sensors ``ids``."""
        which = slice(None) if ids is None else ids
        came = self.arrivals.since(self.since[which], step, which)
        return np.minimum(self.base[which] + came, float(self._scenario.queue_capacity))

    def present(self, step: int) -> list[int]:
        """The UAVs located in this step or the one before."""
        return sorted(uav for uav, last in self.uavs.items() if step - 1 <= last.step <= step)

    def decided(self, step: int) -> dict[int, tuple[int, int]]:
        """The UAVs' decisions in this step: sensor and velocity by index."""
        return {uav: last.action for uav, last in self.uavs.items() if last.step == step and last.action is not None}

    def trajectory(self, uav: int) -> Trajectory:
        """The UAV's trajectory."""
        return self._paths[uav]

    def links(self, uav: int, metres: ArrayLike) -> ExpectedLinks:
        """The links to the UAV after it has flown ``metres`` ``(n,)`` on, ``(n, J)``."""
        ahead = self.uavs[uav].ahead(self._paths[uav], self.drift, metres)
        return self.channel.links(ahead, _distances_between(ahead, self.places))

    def distances(self, uav: int, metres: ArrayLike) -> FloatArray:
        """Horizontal distances, metres, ``(n, J)``, after the UAV has flown ``metres`` ``(n,)`` on.

        A sensor of unknown position is far away.
        """
        return _distances_between(self.uavs[uav].ahead(self._paths[uav], self.drift, metres), self.places)


def _distances_between(ahead: FloatArray, places: FloatArray) -> FloatArray:
    """Distances ``(n, J)`` of a UAV's places ``(n, 2)`` to the sensors' ``(J, 2)``; far for an unknown position."""
    offset = ahead[:, None, :] - places
    metres_off: FloatArray = np.hypot(offset[..., 0], offset[..., 1])
    metres_off[np.isnan(metres_off)] = FAR_M
    return metres_off
