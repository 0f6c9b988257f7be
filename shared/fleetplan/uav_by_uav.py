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
from shared.fleetplan.problem import FleetProblem
from shared.fleetplan.queue_chains import Floats

# Changes that save less do not count, packets. The second is of plans from which a UAV's visits were taken.
_LEAST_GAIN, _LEAST_GAIN_ANEW = 1e-3, 0.01
_ROUNDS = 3


@dataclass(frozen=True)
class _Step:
    """The ways that reach each place in one step: their source, velocity and sensor (-1: none), ``(C,)``."""

    source: IntArray
    velocity: IntArray
    sensor: IntArray


def searched(problem: FleetProblem, start: IntArray, seconds: float = math.inf) -> IntArray:
    """The actions after a search from ``start`` ``(H, I, 2)``, never of more expected loss.

    The UAVs' actions are improved in turn until none improves. Then, for one UAV after another, its visits are taken
    from the plan, the others' actions are improved once, and then its own: so that UAVs exchange sensors.

    Args:
        problem: with ``chains``.
        start: begins with the problem's fixed actions.
        seconds: limit of the wall clock; the plan then depends on the machine.
    """
    search = _Search(problem, time.perf_counter() + seconds)
    free = [u for u in range(problem.uavs) if len(problem.fixed.get(u, ())) < problem.horizon]
    best, cost = search.descend(start, search.loss.of(start), free, _ROUNDS)
    tried: set[int] = set()
    while len(free) > 1 and len(tried) < len(free):
        uav = next(u for u in free if u not in tried)
        tried.add(uav)
        without = best.copy()
        without[len(problem.fixed.get(uav, ())) :, uav, 0] = search.nowhere
        first = free.index(uav) + 1
        found, now = search.descend(without, search.loss.of(without), [*free[first:], *free[:first]], 1)
        if now < cost - _LEAST_GAIN_ANEW:
            best, cost, tried = found, now, {uav}
    return best


class _Search:
    """The search for one problem's plan, until a moment of the wall clock."""

    def __init__(self, problem: FleetProblem, until: float) -> None:
        self.loss = ExpectedLoss(problem)
        self._problem, self._until = problem, until
        # A plan's problem has a last sensor that is nowhere.
        self.nowhere = problem.sensors - 1
        q = np.arange(self.loss.count + 1)
        self._left = np.maximum(q[:, None] - q, 0)

    def descend(self, actions: IntArray, cost: float, order: Sequence[int], rounds: int) -> tuple[IntArray, float]:
        """Actions and their expected loss after improving these UAVs' actions in turn, until none improves."""
        stale = 0
        for turn in range(rounds * len(order)):
            if stale == len(order) or time.perf_counter() > self._until:
                break
            found = self._way(actions, order[turn % len(order)])
            now = self.loss.of(found)
            stale += 1
            if now < cost - _LEAST_GAIN:
                actions, cost, stale = found, now, 1
        return actions, cost

    def _way(self, actions: IntArray, uav: int) -> IntArray:
        """The actions with the best ones found for one UAV: dynamic programming over steps and sums of velocities.

        For each sum of velocities the best way there stays, with the odds of all queues on it. Its score is the
        expected loss of the whole plan if this UAV visits nothing more.
        """
        loss, problem = self.loss, self._problem
        visits, stage = loss.visits(actions, uav), loss.stage(actions)
        values = loss.values(visits, stage)
        ways = _Ways(self, uav, visits, values)
        steps = []
        for step in range(problem.horizon):
            fixed = problem.fixed.get(uav, ())
            taken = np.delete(actions[step, :, 0], uav)
            steps.append(ways.fly(step, self._left, fixed[step] if step < len(fixed) else None, taken))
        place = int((ways.scores + ways.ending(loss.stage(actions, uav), stage)).argmin())
        found = actions.copy()
        for step in range(problem.horizon - 1, -1, -1):
            made = steps[step]
            if step >= len(problem.fixed.get(uav, ())):
                sensor = int(made.sensor[place])
                found[step, uav] = self.nowhere if sensor < 0 else sensor, made.velocity[place]
            place = int(made.source[place])
        return found


class _Ways:
    """The ways of one UAV to every place that it can reach, as sums of velocities ``low`` to ``low + C - 1``.

    Attributes:
        scores: shape ``(C,)``, expected losses; infinite where no way leads.
        odds: shape ``(J, C, G + 1)``, of the queues' levels.
        since: shape ``(J, C)``, one more than the step of the last visit, 0 without one.
    """

    def __init__(self, search: _Search, uav: int, visits: list[Visits], values: list[Floats]) -> None:
        loss = self._loss = search.loss
        self._problem, self._uav, self._visits, self._values = loss.problem, uav, visits, values
        self.low = 0
        self.odds: Floats = loss.chains.start[:, None]
        self.scores: Floats = np.array([(loss.chains.start * values[0]).sum()])
        self.since = np.zeros((loss.problem.sensors, 1), dtype=np.int64)

    def fly(self, step: int, left: IntArray, fixed: IntArray | None, taken: IntArray) -> _Step:
        """Fly one step, with a fixed action or without; ``taken`` are the sensors that other UAVs name in it."""
        problem, visits = self._problem, self._visits[step]
        levels = problem.levels if fixed is None else fixed[1:]
        free = np.ones(problem.sensors, dtype=np.bool_)
        if fixed is not None:
            free = (np.arange(problem.sensors) == fixed[0]) & ~np.isin(fixed[0], list(visits))
        else:
            if problem.usable is not None:
                free = problem.usable[step].copy()
            free[taken] = False
        gains, sensors = self._gains(step, levels, free, left)
        count = len(self.scores)
        low = self.low + int(levels[0])
        targets = np.arange(low, self.low + count + int(levels[-1]))
        source = targets[:, None] - levels - self.low
        within = (source >= 0) & (source < count)
        source = np.where(within, source, 0)
        every = np.arange(len(levels))
        reached = np.where(within, (self.scores[:, None] - gains)[source, every], np.inf)
        # Of equal ways the fastest step.
        level = len(levels) - 1 - reached[:, ::-1].argmin(axis=1)
        rows = np.arange(len(targets))
        source, self.scores = source[rows, level], reached[rows, level]
        sensor = np.where(gains[source, level] > 1e-7, sensors[source, level], -1)
        self.low = low
        self._serve(step, source, sensor, targets)
        return _Step(source, levels[level], sensor)

    def _gains(self, step: int, levels: IntArray, free: NDArray[np.bool_], left: IntArray) -> tuple[Floats, IntArray]:
        """What the best visit saves after each way and velocity, packets, and its sensor, ``(C, V)``."""
        rows = np.arange(len(self.scores))
        ahead = rows[:, None] + levels
        reached = slice(self.low, self.low + len(rows) + int(levels[-1]))
        moves, chance = (table[reached] for table in self._loss.links(self._uav, step))
        some = np.flatnonzero(chance.any(axis=0) & free)
        if not len(some):
            return np.zeros(ahead.shape, dtype=np.float32), np.full(ahead.shape, -1)
        moves, chance = moves[:, some], chance[:, some]
        # The numbers of levels that a visit may move, beginning with none, and the place of each among them.
        used = np.bincount(moves.ravel(), minlength=len(left))
        used[0] = 1
        place = np.cumsum(used > 0) - 1
        # By sensor, way and the levels moved: the expected losses of that sensor.
        after = self.odds[some] @ self._values[step + 1][some][:, left[:, used > 0]]
        saved = (after[:, :, :1] - after)[np.arange(len(some)), rows[:, None, None], place[moves][ahead]]
        if self._loss.late_until is not None:
            saved = saved + self._lateness(step, some)[:, None]
        gains = chance[ahead] * saved
        best = gains.argmax(axis=2)
        return np.take_along_axis(gains, best[..., None], axis=2)[..., 0], some[best]

    def _lateness(self, step: int, some: IntArray) -> Floats:
        """The lateness that a visit in this step saves until the next UAV's visit, ``(C, n)``."""
        until = self._loss.late_until
        assert until is not None
        horizon = self._problem.horizon
        ends = [next((t for t in range(step + 1, horizon) if j in self._visits[t]), horizon + 1) for j in some.tolist()]
        since = self.since[some].T
        before = until[since, ends, some] - until[since, step, some]
        return np.asarray(before - (until[step + 1, ends, some] - until[step + 1, step, some]), dtype=np.float32)

    def _serve(self, step: int, source: IntArray, sensor: IntArray, targets: IntArray) -> None:
        """Take the odds of the ways' sources through this step's transfers and arrivals."""
        chains = self._loss.chains
        moves, chance = self._loss.links(self._uav, step)
        odds, since = self.odds[:, source], self.since[:, source]
        ways = np.flatnonzero(sensor >= 0)
        mine, at = sensor[ways], targets[ways]
        odds[mine, ways] = chains.served(odds[mine, ways], moves[at, mine], chance[at, mine])
        since[mine, ways] = step + 1
        for j, (moved, likely) in self._visits[step].items():
            odds[j] = chains.served_alike(odds[j], moved, likely)
            since[j] = step + 1
        self.odds, self.since = odds @ chains.arrive[step], since

    def ending(self, others: IntArray, assumed: IntArray) -> Floats:
        """The expected losses after the horizon above those of the assumed stages ``(J,)``, ``(C,)``."""
        after = self._problem.afterwards
        if after is None:
            return np.zeros(len(self.scores), dtype=np.float32)
        sums = self.low + np.arange(len(self.scores))
        stage = np.minimum(after.stages[self._uav][sums], others)
        above = self._loss.ends(stage) - self._loss.ends(assumed)
        return np.asarray((self.odds.transpose(1, 0, 2) * above).sum(axis=(1, 2)))
