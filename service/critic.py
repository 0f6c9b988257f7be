"""The critic: the packets that the fleet is expected to lose after a candidate, by simulating what the edge believes.

It judges advisers, whichever they are, so it must not be short-sighted: one step of look-ahead finds fault with an
adviser that sees further. This is a rollout (Tesauro and Galperin 1996; Bertsekas, Tsitsiklis and Wu 1997): fly the
candidate, let every UAV follow the LLM-free policy for some steps, and count what is lost. A policy that is greedy
against it is never worse, in the model, than the LLM-free policy. More than one such policy, each with its own worth of
speed, and the best of them after each candidate make it a parallel rollout (Chang, Givan and Chong 2004).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from service.reach import VELOCITY_BONUS
from shared.channel import FloatArray, packets_per_step
from shared.scenario import Scenario
from shared.trajectory import progress_of, trajectories
from shared.urgency import urgency
from shared.wire import UavState

Action = tuple[int, int]

_HORIZON = 8
# Losses this long after the horizon still count, as if nobody came in the meantime.
_BEYOND = 4
# What a metre a second is worth in urgent packets to each of the policies that fly on.
_BONUSES = (VELOCITY_BONUS,)
# Futures that every candidate is flown through: the same ones, so that their difference is not the arrivals'. On 8
# worlds of scenario `paper`, flying what the critic likes best lost 38 packets with 8 futures, 33 with 24, 30 with 48.
_FUTURES = 48
# Array entries of one judgement; larger worlds get fewer futures. About 5 ns each.
_MOST_ENTRIES = 20_000_000
_MOST_SENSORS = 64
_MOST_UAVS = 10


@dataclass(slots=True)
class _Flying:
    """A UAV as last heard of: at ``step`` it was ``progress_m`` along, at ``position``, and was told ``action``."""

    step: int
    position: tuple[float, float]
    progress_m: float | None
    action: Action | None = None


class Belief:
    """What a fleet knows together: of each sensor the newest beacon less what was collected, of each UAV where it is.

    A sensor never heard is taken to have begun with the mean of the queues that the scenario draws from.

    Attributes:
        queue: shape ``(J,)``, packets at the start of step ``since``.
        since: shape ``(J,)``, steps.
        places: shape ``(J, 2)``, metres; NaN for a sensor that nobody reported.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._heard: NDArray[np.int64] = np.full(scenario.sensors, -1)
        self._flying: dict[int, _Flying] = {}
        self.queue: FloatArray = np.full(
            scenario.sensors, (1 + scenario.initial_queue_min) / 2 * scenario.queue_capacity
        )
        self.since: NDArray[np.int64] = np.zeros(scenario.sensors, dtype=np.int64)
        self.places: FloatArray = np.full((scenario.sensors, 2), np.nan)

    def hear(self, uav: UavState, step: int) -> None:
        """Take a UAV's report: beacons newer than what is known, and where it is."""
        columns = uav.sensors
        ids = np.asarray(columns.id)
        self.places[ids] = np.stack((columns.x, columns.y), axis=1)
        seen = np.array([-1 if s is None else s for s in columns.last_seen], dtype=np.int64)
        queue = np.array([0.0 if q is None else q for q in columns.queue])
        battery = np.array([1.0 if b is None else b for b in columns.battery])
        newer = seen > self._heard[ids]
        kept = ids[newer]
        # Nothing can be collected from a flat sensor, so nothing that is lost there tells candidates apart.
        self.queue[kept] = np.where(battery > 0, queue, 0.0)[newer]
        self.since[kept] = self._heard[kept] = seen[newer]
        position = (uav.position[0], uav.position[1])
        path = trajectories(self._scenario)[uav.uav_id]
        self._flying[uav.uav_id] = _Flying(step, position, progress_of(path, position, uav.progress_m))

    def told(self, uav: int, step: int, action: Action, rates: FloatArray) -> None:
        """A UAV was answered: it will be elsewhere, and what it collects is gone."""
        flying = self._flying.get(uav)
        if flying is None or flying.step != step:
            return
        flying.action = action
        sensor, velocity = action
        if np.isnan(self.places[sensor, 0]):
            return
        ahead = self.links(uav, step, velocity + 1)[velocity, sensor]
        left = max(0.0, float(self.expected(step, rates)[sensor]) - float(ahead))
        self.queue[sensor], self.since[sensor] = left, step

    def expected(self, step: int, rates: FloatArray) -> FloatArray:
        """Expected queues at the start of a step, packets, ``(J,)``."""
        grown = self.queue + rates * np.maximum(step - self.since, 0)
        return np.minimum(grown, float(self._scenario.queue_capacity))

    def present(self, step: int) -> list[int]:
        """The UAVs heard of in this step or the one before, whose whereabouts are known."""
        return sorted(uav for uav, flying in self._flying.items() if step - 1 <= flying.step <= step)

    def decided(self, uav: int, step: int) -> Action | None:
        """What a UAV was told to do in this step, if it was asked before."""
        flying = self._flying[uav]
        return flying.action if flying.step == step else None

    def links(self, uav: int, step: int, count: int) -> FloatArray:
        """Packets that a step can move from where the UAV is after 0..count - 1 metres a second, ``(count, J)``."""
        flying = self._flying[uav]
        scenario = self._scenario
        if flying.progress_m is None:
            ahead = np.broadcast_to(np.asarray(flying.position), (count, 2))
        else:
            flown = flying.action[1] if flying.action is not None and flying.step < step else 0
            start = flying.progress_m + flown * scenario.step_s
            ahead = trajectories(scenario)[uav].at(start + np.arange(count) * scenario.step_s)
        distance = np.linalg.norm(np.nan_to_num(self.places, nan=1e9)[None] - ahead[:, None], axis=2)
        return packets_per_step(distance, scenario).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Situation:
    """What the critic needs to judge one UAV's candidates, taken from a belief at once: another thread may judge.

    Attributes:
        kept: shape ``(n,)``, IDs of the sensors that matter: in reach of a UAV within the horizon.
        queue, waited, rates: shape ``(n,)``: packets last known of, those expected since, and a step's.
        links: by UAV, shape ``(horizon x max_velocity + 1, n)``: packets movable after that many metres a second.
        told: velocities of the UAVs that decided in this step already.
        reserved: shape ``(n,)``, sensors that others were given in this step.
    """

    scenario: Scenario
    uav: int
    horizon: int
    beyond: int
    seed: tuple[int, int, int]
    kept: NDArray[np.int64]
    queue: FloatArray
    waited: FloatArray
    rates: FloatArray
    links: dict[int, FloatArray]
    told: dict[int, int]
    reserved: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        belief: Belief,
        rates: FloatArray,
        scenario: Scenario,
        step: int,
        uav: int,
        *,
        seed: int = 0,
        reserved: Collection[int] = (),
    ) -> Situation:
        """As things stand when this UAV decides at this step."""
        left = scenario.steps - step
        # Past the scenario's last step a fleet may fly on.
        horizon = min(_HORIZON, left) if left > 0 else _HORIZON
        beyond = min(_BEYOND, left - horizon) if left > 0 else _BEYOND
        # The nearest by index are as good as any: who is near changes within the horizon.
        others = [other for other in belief.present(step) if other != uav][: _MOST_UAVS - 1]
        links = {i: belief.links(i, step, horizon * scenario.max_velocity + 1) for i in (uav, *others)}
        reached = np.flatnonzero(np.any([(table > 0).any(axis=0) for table in links.values()], axis=0))
        room = (scenario.queue_capacity - belief.expected(step, rates)) / np.maximum(rates, 1e-9)
        kept = np.sort(reached[np.argsort(room[reached], kind="stable")[:_MOST_SENSORS]])
        told = {i: action[1] for i in others if (action := belief.decided(i, step)) is not None}
        return cls(
            scenario=scenario,
            uav=uav,
            horizon=horizon,
            beyond=beyond,
            seed=(seed, step, uav),
            kept=kept,
            queue=belief.queue[kept],
            waited=(rates * np.maximum(step - belief.since, 0))[kept],
            rates=rates[kept],
            links={i: table[:, kept] for i, table in links.items()},
            told=told,
            reserved=np.isin(kept, list(reserved)),
        )


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is expected of C candidates, ``(C,)`` each.

    ``lost``: packets that the fleet loses over the horizon and, with nobody coming, four more steps. ``cost``: the cost
    of the step itself as the UAV will report it, ``f + lost / W`` of the sensors that it could have served.
    """

    lost: FloatArray
    cost: FloatArray


def judge(situation: Situation, candidates: Sequence[Action]) -> Judgement:
    """Fly every candidate through the same futures, and count; takes milliseconds to tens of them."""
    scenario, sensors, count = situation.scenario, len(situation.kept), len(candidates)
    capacity = float(scenario.queue_capacity)
    entries = count * max(1, sensors) * (scenario.max_velocity + 1) * len(situation.links) * situation.horizon
    futures = int(np.clip(_MOST_ENTRIES // (entries * len(_BONUSES)), 1, _FUTURES))
    random = np.random.default_rng(situation.seed)
    start = np.minimum(situation.queue + random.poisson(situation.waited, (futures, sensors)), capacity)
    arrivals = random.poisson(situation.rates, (situation.horizon, futures, sensors)).astype(np.float64)
    after = random.poisson(situation.beyond * situation.rates, (futures, sensors)).astype(np.float64)
    # A sensor out of everyone's reach is one past the kept, with a link that never holds.
    rows = np.searchsorted(situation.kept, [sensor for sensor, _ in candidates])
    known = np.isin([sensor for sensor, _ in candidates], situation.kept)
    first = np.repeat(np.stack((np.where(known, rows, 0), [v for _, v in candidates]), axis=1), futures, axis=0)
    collects = np.repeat(known, futures)
    losses = []
    for bonus in _BONUSES:
        world = _Copies(situation, np.tile(start, (count, 1)), bonus)
        cost = world.fly_first(first, collects)
        lost = world.arrive(np.tile(arrivals[0], (count, 1)))
        cost += world.overflow_in_reach / capacity
        for turn in range(1, situation.horizon):
            world.fly()
            lost += world.arrive(np.tile(arrivals[turn], (count, 1)))
        lost += world.arrive(np.tile(after, (count, 1)))
        losses.append(lost.reshape(count, futures).mean(axis=1))
    return Judgement(np.min(losses, axis=0), cost.reshape(count, futures).mean(axis=1))


class _Copies:
    """B copies of the situation: queues ``(B, n)`` and the metres a second that each UAV flew so far."""

    def __init__(self, situation: Situation, queue: FloatArray, bonus: float) -> None:
        self._situation = situation
        scenario = situation.scenario
        self._capacity = float(scenario.queue_capacity)
        self._bonus = bonus * np.arange(scenario.max_velocity + 1, dtype=np.float64)
        levels = np.arange(scenario.queue_capacity + 1, dtype=np.float64)[:, None]
        self._urgency = urgency(levels, situation.rates, scenario)
        # (metres a second so far, n, V): what can be moved after one more step at each velocity.
        self._ahead = {
            uav: sliding_window_view(table, scenario.max_velocity + 1, axis=0) for uav, table in situation.links.items()
        }
        self._flown = {uav: np.zeros(len(queue), dtype=np.int64) for uav in self._ahead}
        self._queue = queue
        self._rows, self._columns = np.arange(len(queue)), np.arange(queue.shape[1])
        self._in_reach = np.zeros_like(queue, dtype=np.bool_)
        self.overflow_in_reach: FloatArray = np.zeros(len(queue))

    def fly_first(self, first: NDArray[np.int64], collects: NDArray[np.bool_]) -> FloatArray:
        """The step of the candidates ``(B, 2)``: who was told does so, the rest follow; returns f, ``(B,)``."""
        situation, own = self._situation, self._situation.uav
        served = np.tile(situation.reserved, (len(first), 1))
        failed: FloatArray = np.ones(len(first))
        velocity = first[:, 1]
        if len(self._columns):
            ahead = self._ahead[own][0].T[velocity]
            self._in_reach = ahead > 0
            served_now = self._serve(first[:, 0], np.where(collects, ahead[self._rows, first[:, 0]], 0.0), served)
            failed = np.where(served_now, 0.0, 1.0)
        self._flown[own] += velocity
        for uav in self._ahead:
            if uav in situation.told:
                # What it collects was taken off the belief when it was told.
                self._flown[uav] += situation.told[uav]
            elif uav != own:
                self._follow(uav, served)
        return failed

    def fly(self) -> None:
        """A step in which every UAV follows the policy."""
        served = np.zeros_like(self._queue, dtype=np.bool_)
        for uav in self._ahead:
            self._follow(uav, served)

    def arrive(self, arrivals: FloatArray) -> FloatArray:
        """What overflows, ``(B,)`` packets."""
        filled = self._queue + arrivals
        self._queue = np.minimum(filled, self._capacity)
        over = filled - self._queue
        self.overflow_in_reach = np.asarray(np.where(self._in_reach, over, 0.0).sum(axis=1))
        return np.asarray(over.sum(axis=1))

    def _follow(self, uav: int, served: NDArray[np.bool_]) -> None:
        """One step of look-ahead, as in :func:`service.policy.decide_without_llm`."""
        if not len(self._columns):
            return
        ahead = self._ahead[uav][self._flown[uav]]
        urgencies = self._urgency[self._queue.astype(np.int64), self._columns]
        movable = np.minimum(ahead, np.where(served, 0.0, self._queue)[..., None])
        worth = urgencies[..., None] * movable + self._bonus
        sensor, velocity = np.unravel_index(worth.reshape(len(worth), -1).argmax(axis=1), worth.shape[1:])
        self._serve(sensor, ahead[self._rows, sensor, velocity], served)
        self._flown[uav] += velocity

    def _serve(self, sensor: NDArray[np.int64], link: FloatArray, served: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Move packets from sensors ``(B,)`` over links that can move so many; returns where that succeeded."""
        holds = (link > 0) & ~served[self._rows, sensor]
        waiting = self._queue[self._rows, sensor]
        self._queue[self._rows, sensor] = waiting - np.where(holds, np.minimum(waiting, link), 0.0)
        served[self._rows, sensor] |= holds
        return holds
