"""Plans over uncertain links: each UAV's actions in turn become the best that are found beside the others'."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.channel import IntArray
from shared.fleetplan.expected_loss import ExpectedLoss, Visits
from shared.fleetplan.queue_chains import Floats

# Changes that save less do not count, packets. The second is of plans from which a UAV's visits were taken.
_LEAST_GAIN, _LEAST_GAIN_ANEW = 1e-3, 0.01
_ROUNDS = 3


def searched(loss: ExpectedLoss, starts: Sequence[IntArray], seconds: float = math.inf) -> tuple[IntArray, float]:
    """The actions and their expected loss after a search from the best of ``starts``, ``(H, I, 2)`` each.

    They never lose more than their start.

    The UAVs' actions are improved in turn until none improves. Then, for one UAV after another, its visits are taken
    from the plan, the others' actions are improved once, and then its own: so that UAVs exchange sensors.

    Args:
        loss: of the problem to solve.
        starts: each begins with the problem's fixed actions.
        seconds: limit of the wall clock; the plan then depends on the machine.
    """
    problem, search = loss.problem, _Search(loss, time.perf_counter() + seconds)
    free = [u for u in range(problem.uavs) if len(problem.fixed.get(u, ())) < problem.horizon]
    start = min(starts, key=loss.of)
    best, cost = search.descend(start, loss.of(start), free, _ROUNDS)
    tried: set[int] = set()
    while len(free) > 1 and len(tried) < len(free):
        uav = next(u for u in free if u not in tried)
        tried.add(uav)
        without = best.copy()
        without[len(problem.fixed.get(uav, ())) :, uav, 0] = search.nowhere
        first = free.index(uav) + 1
        found, now = search.descend(without, loss.of(without), [*free[first:], *free[:first]], 1)
        if now < cost - _LEAST_GAIN_ANEW:
            best, cost, tried = found, now, {uav}
    return best, cost


class _Search:
    """The search for one problem's plan, until a moment of the wall clock."""

    def __init__(self, loss: ExpectedLoss, until: float) -> None:
        self.loss, self._problem, self._until = loss, loss.problem, until
        # A plan's problem has a last sensor that is nowhere.
        self.nowhere = loss.problem.sensors - 1
        q = np.arange(self.loss.count + 1)
        self.left: IntArray = np.maximum(q[:, None] - q, 0)
        self._steps: dict[tuple[int, int, int, int, int], _Step] = {}
        self._arrive = [self.loss.chains.arrive[:, near] for near in self.loss.near]

    def descend(self, actions: IntArray, cost: float, order: Sequence[int], rounds: int) -> tuple[IntArray, float]:
        """Actions and their expected loss after improving these UAVs' actions in turn, until none improves."""
        stale = 0
        for turn in range(rounds * len(order)):
            if stale == len(order) or time.perf_counter() > self._until:
                break
            found, now = self._way(actions, order[turn % len(order)])
            stale += 1
            if now < cost - _LEAST_GAIN:
                actions, cost, stale = found, now, 1
        return actions, cost

    def _way(self, actions: IntArray, uav: int) -> tuple[IntArray, float]:
        """The plan with the best actions found for one UAV, and its cost: dynamic programming over steps and places.

        A place is a sum of velocities. For each the best way there stays, with the odds of the queues on it. Its score
        is the expected loss of the whole plan if this UAV visits nothing more.
        """
        problem, fixed = self._problem, self._problem.fixed.get(uav, ())
        others, ahead = self.loss.visits(actions, uav), self.loss.stage(actions)
        ways, flown = _Ways(self, uav, others, ahead), []
        for step in range(problem.horizon):
            if step < len(fixed):
                flown.append(ways.fly_fixed(step, *fixed[step].tolist()))
            else:
                flown.append(ways.fly(step, np.delete(actions[step, :, 0], uav)))
        costs = ways.scores + ways.ending(self.loss.stage(actions, uav), ahead)
        end = place = int(costs.argmin())
        found = actions.copy()
        for step in range(problem.horizon - 1, -1, -1):
            source, velocity, sensor = (column[place] for column in flown[step])
            if step >= len(fixed):
                found[step, uav] = self.nowhere if sensor < 0 else self.loss.near[uav][sensor], velocity
            place = int(source)
        # The scores take lateness as if every earlier visit had been sure.
        return found, float(costs[end]) if problem.late is None else self.loss.of(found)

    def step(self, uav: int, step: int, low: int, count: int, velocity: int | None = None) -> _Step:
        """The step from ``count`` places, from the sum ``low`` of velocities on; at every velocity or at one."""
        key = uav, step, low, count, -1 if velocity is None else velocity
        if key not in self._steps:
            levels = self._problem.levels[::-1] if velocity is None else np.array([velocity])
            self._steps[key] = _Step.of(self, uav, step, np.arange(low, low + count), levels)
        return self._steps[key]

    def arrive(self, uav: int, step: int) -> Floats:
        """A step's arrivals ``(n, G + 1, G + 1)`` at the sensors near a UAV."""
        return np.asarray(self._arrive[uav][step])


@dataclass(frozen=True, slots=True)
class _Step:
    """One step of a UAV from C places at V velocities, whatever the other UAVs do; it ends at C' places.

    Attributes:
        velocity: shape ``(V,)``, fastest first.
        places: shape ``(C',)``, sums of velocities.
        origin: shape ``(C', V)``, the number of the place and velocity, of C x V, that leads there.
        within: shape ``(C', V)``, whether there is one.
        some: shape ``(n,)``, the sensors within reach, as places among those near the UAV.
        left: shape ``(G + 1, L)``, the level from each after a transfer of each number of levels, beginning with none.
        moved: shape ``(n, C, V)``, numbers in ``(n, C, L)``: what each visit leaves.
        chance: shape ``(n, C, V)``, of each visit's link.
    """

    velocity: IntArray
    places: IntArray
    origin: IntArray
    within: NDArray[np.bool_]
    some: IntArray
    left: IntArray
    moved: IntArray
    chance: Floats

    @classmethod
    def of(cls, search: _Search, uav: int, step: int, sums: IntArray, velocity: IntArray) -> _Step:
        """The step of one UAV from these sums of velocities, with these velocities, fastest first."""
        count, levels = len(sums), len(velocity)
        slowest, fastest = int(velocity[-1]), int(velocity[0])
        places = np.arange(sums[0] + slowest, sums[-1] + fastest + 1)
        source = places[:, None] - velocity - sums[0]
        within = (source >= 0) & (source < count)
        near = search.loss.near[uav]
        moves, chance = (table[:, near] for table in search.loss.links(uav, step))
        some = np.flatnonzero(chance[places].any(axis=0))
        moves, chance = moves[:, some], chance[:, some]
        used = np.bincount(moves[places].ravel(), minlength=len(search.left))
        used[0] = 1
        number = np.cumsum(used > 0) - 1
        ahead = sums[:, None] + velocity
        rows = np.arange(len(some))[:, None, None] * count + np.arange(count)[:, None]
        return cls(
            velocity=velocity,
            places=places,
            origin=np.where(within, source, 0) * levels + np.arange(levels),
            within=within,
            some=some,
            left=search.left[:, used > 0],
            moved=rows * int(np.count_nonzero(used)) + number[moves[ahead]].transpose(2, 0, 1),
            chance=np.ascontiguousarray(chance[ahead].transpose(2, 0, 1)),
        )


class _Ways:
    """The ways of one UAV to every place that it can reach.

    Attributes:
        places: shape ``(C,)``, the places as sums of velocities.
        scores: shape ``(C,)``, expected losses; infinite where no way leads.
        odds: shape ``(n, C, G + 1)``, of the queues' levels, of the sensors near the UAV.
        since: shape ``(n, C)``, one more than the step of the last visit, 0 without one.
    """

    def __init__(self, search: _Search, uav: int, others: Visits, stage: IntArray) -> None:
        loss = self._loss = search.loss
        self._search, self._uav, self._others = search, uav, others
        self._near = near = loss.near[uav]
        values = loss.values(others, stage)
        self._values = values[near]
        self._beside: list[list[tuple[int, int, float]]] = [[] for _ in range(loss.problem.horizon)]
        for row, sensor in enumerate(near.tolist()):
            for step, levels, chance in others.get(sensor, ()):
                self._beside[step].append((row, levels, chance))
        self.places: IntArray = np.zeros(1, dtype=np.int64)
        self.odds: Floats = loss.chains.start[near][:, None]
        self.scores: Floats = np.array([loss.start(values)])
        self.since = np.zeros((len(near), 1), dtype=np.int64)

    def fly(self, step: int, taken: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Fly one step; ``taken`` are the sensors that other UAVs name in it.

        Returns:
            by place the source, the velocity, and the sensor among those near (-1: none), ``(C',)`` each.
        """
        usable = self._loss.problem.usable
        free = np.ones(self._loss.problem.sensors, dtype=np.bool_) if usable is None else usable[step].copy()
        free[taken] = False
        now = self._search.step(self._uav, step, int(self.places[0]), len(self.places))
        return self._fly(step, now, free[self._near])

    def fly_fixed(self, step: int, sensor: int, velocity: int) -> tuple[IntArray, IntArray, IntArray]:
        """Fly one step with a fixed action; returns as :meth:`fly`."""
        free = self._near == sensor
        free[[row for row, _, _ in self._beside[step]]] = False
        now = self._search.step(self._uav, step, int(self.places[0]), len(self.places), velocity)
        return self._fly(step, now, free)

    def _fly(self, step: int, now: _Step, free: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
        gains = self._gains(step, now, free)
        scores = self.scores[:, None] - gains.max(axis=0, initial=0.0)
        reached = np.where(now.within, scores.take(now.origin), np.inf)
        # Of equal ways the fastest step.
        level = reached.argmin(axis=1)
        rows = np.arange(len(level))
        origin = now.origin[rows, level]
        source = origin // len(now.velocity)
        sensor = np.full(len(level), -1)
        if len(gains):
            saved = gains.reshape(len(gains), -1)[:, origin]
            sensor = np.where(saved.max(axis=0) > 1e-7, now.some[saved.argmax(axis=0)], -1)
        self.scores, self.places = reached[rows, level], now.places
        self._serve(step, source, sensor)
        return source, now.velocity[level], sensor

    def _gains(self, step: int, now: _Step, free: NDArray[np.bool_]) -> Floats:
        """What visits save after each way and velocity, packets, ``(n, C, V)``, none of sensors that are not free."""
        some = now.some
        # By sensor, way and the levels moved: the expected losses of that sensor.
        after = self.odds[some] @ self._values[some, step + 1][:, now.left]
        saved = after[:, :, :1] - after.take(now.moved)
        if self._loss.late_until is not None:
            saved = saved + self._lateness(step, some)[..., None]
        return np.asarray(now.chance * saved * free[some, None, None])

    def _lateness(self, step: int, some: IntArray) -> Floats:
        """The lateness that a visit in this step saves until the next UAV's visit, ``(n, C)``."""
        until, horizon = self._loss.late_until, self._loss.problem.horizon
        assert until is not None
        sensors = self._near[some]
        following = [[t for t, _, _ in self._others.get(j, ()) if t > step] for j in sensors.tolist()]
        ends = np.array([steps[0] if steps else horizon + 1 for steps in following])[:, None]
        since, sensors = self.since[some], sensors[:, None]
        before = until[since, ends, sensors] - until[since, step, sensors]
        return np.asarray(before - (until[step + 1, ends, sensors] - until[step + 1, step, sensors]), dtype=np.float32)

    def _serve(self, step: int, source: IntArray, sensor: IntArray) -> None:
        """Take the odds of the ways' sources through this step's transfers and arrivals."""
        moves, chance = self._loss.links(self._uav, step)
        odds, since = self.odds.take(source, axis=1), self.since.take(source, axis=1)
        ways = np.flatnonzero(sensor >= 0)
        mine = sensor[ways]
        at = self.places[ways], self._near[mine]
        odds[mine, ways] = self._loss.chains.served(odds[mine, ways], moves[at], chance[at])
        since[mine, ways] = step + 1
        arrive = self._search.arrive(self._uav, step)
        if self._beside[step]:
            arrive = arrive.copy()
            for row, levels, likely in self._beside[step]:
                # Another UAV's transfer before the arrivals.
                arrive[row] += np.float32(likely) * (arrive[row, self._search.left[:, levels]] - arrive[row])
                since[row] = step + 1
        self.odds, self.since = odds @ arrive, since

    def ending(self, others: IntArray, assumed: IntArray) -> Floats:
        """The expected losses after the horizon above those of the assumed stages ``(J,)``, ``(C,)``."""
        after = self._loss.problem.afterwards
        if after is None:
            return np.zeros(len(self.scores), dtype=np.float32)
        stage = np.minimum(after.stages[self._uav][self.places], others)
        far = np.asarray((stage != assumed).any(axis=0))
        far[self._near] = False
        total = self._above(self.odds, self._near, stage, assumed)
        if far.any():
            sensors = np.flatnonzero(far)
            total = total + self._above(self._loss.odds(sensors, self._others)[:, None], sensors, stage, assumed)
        return total

    def _above(self, odds: Floats, sensors: IntArray, stage: IntArray, assumed: IntArray) -> Floats:
        """The expected losses of some sensors after the horizon above those of their assumed stages, ``(C,)``."""
        # By sensor, way and stage.
        lost = odds @ self._loss.ends[sensors]
        lost = lost - np.take_along_axis(lost, assumed[sensors, None, None], axis=2)
        each, ways = np.arange(len(sensors)), np.arange(len(stage))[:, None]
        return np.asarray(lost[each, ways if lost.shape[1] > 1 else 0, stage[:, sensors]].sum(axis=1))
