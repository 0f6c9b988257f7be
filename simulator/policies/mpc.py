"""Receding-horizon planning: what a practitioner would fly instead of asking an LLM."""

from __future__ import annotations

from typing import Any

import numpy as np

from shared.channel import FloatArray, packets_per_step
from shared.fleetplan import Budget, FleetProblem, IntArray, Plan, look_ahead, neglect, plan, price
from shared.scenario import Scenario
from shared.trajectory import trajectories
from simulator.policies.reach import longest_silent
from simulator.world import Observation

_HORIZON = 8
# Losses this long after the horizon still count, as if nobody came in the meantime.
_BEYOND = 4
# Deterministic seconds of search for a whole fleet's step: what it may take, and what it may take on average, so that
# a hard world does not cost a multiple of an easy one. A mission begins with some saved.
_MOST_WORK = 0.3
_WORK = 0.1
_SAVED_WORK = 1.0
# Larger fleets plan UAV by UAV, each with the others' plans as they stand, and less far.
_JOINT_UAVS = 4
_NEAR_HORIZON = 4
_MOST_SENSORS = 40
_NEAR_SENSORS = 16
_FAR_M = 1e9


class FleetBelief:
    """What a fleet knows together of the sensors: the newest beacons, rolled forward.

    A sensor never heard is taken to have begun with the mean of the queues that the scenario draws from.

    The rate of each sensor has a Gamma prior of the scenario's mean and variance (of a uniform distribution over its
    range), and what came between successive beacons of queues that were not full makes it a posterior.

    Attributes:
        base: shape ``(J,)``, packets at the start of step ``since``, less what was collected in it.
        since: shape ``(J,)``, steps.
        heard: shape ``(J,)``, the step of the newest beacon, -1 for none.
        battery: shape ``(J,)``, joules.
        arrived, watched: shape ``(J,)``, the Gamma's shape and rate: packets, and the steps that they came in.
    """

    def __init__(self, scenario: Scenario) -> None:
        count, capacity, fewest = scenario.sensors, scenario.queue_capacity, scenario.initial_queue_min
        self._capacity = capacity
        self._drawn_variance = ((1 - fewest) * capacity) ** 2 / 12
        spread = (scenario.arrival_rate_max - scenario.arrival_rate_min) ** 2 / 12
        # A range of no width is known: a prior worth very many steps.
        prior_steps = scenario.mean_arrival_rate / max(spread, 1e-3)
        self.arrived: FloatArray = np.full(count, scenario.mean_arrival_rate * prior_steps)
        self.watched: FloatArray = np.full(count, prior_steps)
        self.base: FloatArray = np.full(count, (1 + fewest) / 2 * capacity)
        self.since: IntArray = np.zeros(count, dtype=np.int64)
        self.heard: IntArray = np.full(count, -1)
        self.battery: FloatArray = np.full(count, scenario.battery_j)

    @property
    def rate(self) -> FloatArray:
        """Expected packets a step, shape ``(J,)``."""
        return self.arrived / self.watched

    @property
    def base_variance(self) -> FloatArray:
        """Of ``base``, shape ``(J,)``: 0 of what was heard."""
        return np.where(self.heard < 0, self._drawn_variance, 0.0)

    def hear(self, observation: Observation) -> None:
        """Take the beacons that are newer than what is known."""
        beacon, queue = observation["last_heard"], observation["queue"]
        newer = beacon > self.heard
        told = newer & (self.heard >= 0) & (beacon > self.since) & (queue < self._capacity)
        self.arrived = self.arrived + np.where(told, np.maximum(queue - self.base, 0.0), 0.0)
        self.watched = self.watched + np.where(told, beacon - self.since, 0)
        self.base = np.where(newer, queue, self.base)
        self.since = np.where(newer, beacon, self.since)
        self.heard = np.where(newer, beacon, self.heard)
        self.battery = np.where(newer, observation["battery"], self.battery)

    def collect(self, sensor: int, packets: int, step: int) -> None:
        """Subtract what a UAV collects in a step."""
        self.base[sensor] = max(0.0, self.queue(step)[sensor] - packets)
        self.since[sensor] = step

    def queue(self, step: int) -> FloatArray:
        """Expected packets at the start of a step, shape ``(J,)``."""
        return np.minimum(self.base + self.rate * (step - self.since), float(self._capacity))


class RecedingHorizon:
    """Plan eight steps ahead for the fleet with CP-SAT, fly the first, and plan again.

    What is minimised are the packets expected to be lost in those steps and, with nobody coming, in four more; see
    :func:`shared.fleetplan.neglect`. Each UAV's observation adds to the fleet's belief when it is asked; the plan is
    then made again for all UAVs, those asked before it in this step held to what they were told. Fleets of more than
    four plan UAV by UAV, four steps ahead.

    The search is limited in the solver's deterministic time, so that a mission repeats to the bit. Steps that are
    solved early save time for others; where none is left, a short search starts from the better of the last plan and
    :func:`shared.fleetplan.look_ahead`, and never ends with a worse one.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._scenario = scenario
        self._paths = trajectories(scenario)
        self._belief = FleetBelief(scenario)
        self._step = -1
        self._progress_m: dict[int, float] = {}
        self._decided: dict[int, tuple[int, int]] = {}
        self._plans: dict[int, IntArray] = {}
        self._joint = scenario.uavs <= _JOINT_UAVS
        self._saved = _SAVED_WORK

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        step = int(observation["step"][0])
        if step != self._step:
            self._carry_out(observation["sensor_position"])
            self._step = step
        self._progress_m[uav] = float(observation["progress"][0])
        self._decided.pop(uav, None)
        self._belief.hear(observation)
        sensor, velocity = self._planned(uav, observation["sensor_position"], taken)
        if sensor in taken:
            sensor = longest_silent(observation, taken)
        self._decided[uav] = sensor, velocity
        return sensor, velocity

    def _carry_out(self, places: FloatArray) -> None:
        """Take the last step's decisions as flown: where the UAVs are now, and what they collected."""
        served = set[int]()
        for uav, (sensor, velocity) in sorted(self._decided.items()):
            self._progress_m[uav] += velocity * self._scenario.step_s
            x, y = self._paths[uav].at(self._progress_m[uav]) - places[sensor]
            packets = int(packets_per_step(np.hypot(x, y), self._scenario))
            if packets and sensor not in served:
                served.add(sensor)
                self._belief.collect(sensor, packets, self._step)
        self._decided.clear()
        self._saved += _WORK
        self._plans = {uav: actions[1:] for uav, actions in self._plans.items()}

    def _planned(self, uav: int, places: FloatArray, taken: frozenset[int]) -> tuple[int, int]:
        """The first action of this UAV in a plan of all UAVs that have been heard of."""
        horizon = max(1, min(_HORIZON if self._joint else _NEAR_HORIZON, self._scenario.steps - self._step))
        uavs = sorted(self._progress_m)
        free = uavs if self._joint else [uav]
        fixed = {u: np.array([told]) for u, told in self._decided.items()}
        fixed |= {u: self._plans[u][:horizon] for u in uavs if u not in free and len(self._plans[u])}
        kept = self._worth_planning(free, places, horizon)
        index = {int(sensor): k for k, sensor in enumerate(kept)}
        nowhere = len(kept)

        def renamed(actions: IntArray) -> IntArray:
            return np.array([(index.get(sensor, nowhere), v) for sensor, v in actions.tolist()], dtype=np.int64)

        problem = FleetProblem(
            scenario=self._scenario,
            trajectories=[self._paths[u] for u in uavs],
            progress_m=np.array([self._progress_m[u] for u in uavs]),
            places=np.concatenate((places[kept], [[_FAR_M, _FAR_M]])),
            fixed={uavs.index(u): renamed(actions) for u, actions in fixed.items()},
            usable=self._usable(kept, horizon, taken),
            **self._outlook(kept, horizon),
        )
        hint = np.empty((horizon, len(uavs), 2), dtype=np.int64)
        hint[:] = nowhere, self._scenario.max_velocity
        for column, u in enumerate(uavs):
            before = self._plans.get(u, np.empty((0, 2), dtype=np.int64))[:horizon]
            hint[: len(before), column] = renamed(before).reshape(-1, 2)
        best = self._searched(problem, hint)
        names = np.append(kept, -1)
        for column, u in enumerate(uavs):
            if u in free:
                self._plans[u] = np.stack((names[best.actions[:, column, 0]], best.actions[:, column, 1]), axis=-1)
        sensor, velocity = self._plans[uav][0].tolist()
        # Nothing in reach for the whole horizon: any sensor will do, the transmission fails.
        return (sensor if sensor >= 0 else int(kept[0])), velocity

    def _searched(self, problem: FleetProblem, before: IntArray) -> Plan:
        """The best plan that a search finds which goes on from the last one, long while the mission has work saved."""
        long = _MOST_WORK / self._scenario.uavs
        if self._joint and self._saved >= long:
            best = plan(problem, Budget(work=long), "cautious", before)
        else:
            start = min(before, look_ahead(problem), key=lambda actions: price(problem, actions)[1])
            best = plan(problem, Budget(work=_WORK / self._scenario.uavs), "cautious", start)
        self._saved -= best.work
        return best

    def _worth_planning(self, free: list[int], places: FloatArray, horizon: int) -> IntArray:
        """The sensors that these UAVs can reach within the horizon; of very many, those that fill first."""
        flown = np.arange(horizon * self._scenario.max_velocity + 1) * self._scenario.step_s
        near = np.zeros(len(places), dtype=np.bool_)
        for uav in free:
            offset = self._paths[uav].at(self._progress_m[uav] + flown)[:, None, :] - places
            near |= (np.hypot(offset[..., 0], offset[..., 1]) <= self._scenario.radio_radius_m).any(axis=0)
        near |= not near.any()
        room = (self._scenario.queue_capacity - self._belief.queue(self._step)) / np.maximum(self._belief.rate, 1e-9)
        order = np.argsort(np.where(near, room, np.inf), kind="stable")
        return np.sort(order[: min(int(near.sum()), _MOST_SENSORS if self._joint else _NEAR_SENSORS)])

    def _usable(self, kept: IntArray, horizon: int, taken: frozenset[int]) -> Any:
        """All but what others, who were not decided for here, have taken in this step."""
        usable = np.ones((horizon, len(kept) + 1), dtype=np.bool_)
        ours = {sensor for sensor, _ in self._decided.values()}
        usable[0, :-1] = ~np.isin(kept, list(taken - ours))
        return usable

    def _outlook(self, kept: IntArray, horizon: int) -> dict[str, Any]:
        """What is expected of the kept sensors, and of one nowhere that never has a packet."""
        world, belief, step = self._scenario, self._belief, self._step
        queue, rate = belief.queue(step)[kept], belief.rate[kept]
        came = np.rint(queue + np.arange(horizon + 1)[:, None] * rate).astype(np.int64)
        beyond = max(0, min(_BEYOND, world.steps - step - horizon))
        risk = neglect(
            base=belief.base[kept],
            base_variance=belief.base_variance[kept],
            age=step - belief.since[kept],
            rate=rate,
            rate_variance=rate / belief.watched[kept],
            capacity=world.queue_capacity,
            horizon=horizon,
            beyond=beyond,
        )
        return {
            "queue": np.append(np.minimum(came[0], world.queue_capacity), 0),
            "battery": np.append(belief.battery[kept], 0.0),
            "arrivals": np.pad(np.diff(came, axis=0), ((0, 0), (0, 1))),
            "risk": np.pad(risk, ((0, 0), (0, 0), (0, 1))),
        }
