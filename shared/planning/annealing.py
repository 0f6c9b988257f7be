"""Simulated annealing of a fleet's actions, compiled: the search of :class:`shared.planning.receding.RecedingHorizon`.

Kirkpatrick, Gelatt and Vecchi, Science 220, 1983. The cost is the exact expectation over links and arrivals of
:class:`shared.planning.queue_chains.QueueChains`.
"""

import math
import time

import numpy as np

from shared.kit.compiled import compiled, inlined
from shared.planning.annealing_arrays import LEVELS, CurrentPlan, Proposal, Tables
from shared.planning.annealing_costs import (
    accept,
    begin,
    copy,
    dot,
    gain,
    know_behind,
    know_odds,
    lateness,
    moving,
    total,
    visited,
)
from shared.planning.fleet_problem import FleetProblem, Found
from shared.planning.queue_chains import Arriving, queue_chains
from shared.world.channel import IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories

# The cumulative shares of the kinds of changes: another sensor in one step; one velocity for several steps; another
# velocity in one step; the same with the opposite change in a later step; the rest exchange two sensors.
_SENSOR, _RUN, _SINGLE, _SHIFT = 0.4, 0.5, 0.65, 0.9
# The cumulative shares of new velocities: any one; the highest one, because some sensors are reached only if every
# velocity is the highest; the rest are one or two levels from the old one.
_ANY_VELOCITY, _HIGHEST_VELOCITY, _NEAR_VELOCITY = 0.4, 0.6, 2
# The share of velocity changes that redraw sensors still in reach, and the share of these sensors.
_ANEW = 0.5
# The value of a collected level of a queue that saves no loss, packets: enough to break ties.
_PACKET = 1e-4
# Changes of a run, at one temperature, and between two checks of the clock; the final temperature, packets.
CHANGES, _SAME_TEMPERATURE, _AT_ONCE, _COLD = 5000, 32, 1000, 0.01


@inlined
def _within(tables: Tables, new: Proposal, step: int, uav: int, j: int) -> bool:
    """Whether a UAV may collect from a sensor in this step: it is in reach, and no other UAV names it."""
    at = min(step, tables.moved.shape[1] - 1)
    if not tables.usable[step, j] or tables.moved[uav, at, new.place[step, uav], j] == 0:
        return False
    named = False
    for other in range(new.sensor.shape[1]):
        named = named or (other != uav and new.sensor[step, other] == j)
    return not named


@inlined
def _below(count: int) -> int:
    """A random number from 0 to ``count - 1``."""
    return int(np.random.random() * count)


@inlined
def _redraw(
    tables: Tables, current: CurrentPlan, new: Proposal, step: int, uav: int, temperature: float, packet: float
) -> None:
    """Draw the sensor of a UAV's step from all admissible ones by their Boltzmann probabilities at this temperature.

    This is the Gumbel-max method: each sensor's saving, with the price of its packets, gets Gumbel noise, and the
    highest sum wins.
    """
    at = min(step, tables.moved.shape[1] - 1)
    place, nowhere = new.place[step, uav], len(tables.start) - 1
    drawn, highest = nowhere, -np.log(-np.log(np.random.random()))
    for k in range(tables.reached.shape[3]):
        j = tables.reached[uav, at, place, k]
        if j < 0:
            break
        if not _within(tables, new, step, uav, j):
            continue
        know_odds(tables, current, new, j, step)
        know_behind(tables, current, new, j, step)
        odds, behind = current.odds[j, step, LEVELS:], current.behind[j, step]
        idle = dot(odds, behind[LEVELS:], new.terms)
        levels, chance = tables.moved[uav, at, place, j], tables.chance[uav, at, place, j]
        saved = float(idle - visited(new, odds, behind, idle, levels, chance))
        if len(tables.late):
            new.sensor[step, uav] = nowhere
            saved += float(lateness(tables, new.sensor, new.place, j))
            new.sensor[step, uav] = j
            saved -= float(lateness(tables, new.sensor, new.place, j))
        if packet > 0.0:
            saved += packet * moving(odds, levels, chance)
        value = saved / temperature - np.log(-np.log(np.random.random()))
        if value > highest:
            drawn, highest = j, value
    new.sensor[step, uav] = drawn


@inlined
def _propose(
    tables: Tables, current: CurrentPlan, new: Proposal, step: int, uav: int, temperature: float, kind: float
) -> bool:
    """Draw a change that begins with a UAV's step; returns whether there is one."""
    steps = len(current.sensor)
    if kind < _SHIFT:
        return _propose_velocity(tables, current, new, step, uav, temperature, kind)
    # Two UAVs exchange their sensors of a step, or one UAV those of two steps.
    other, then = uav, step
    if np.random.random() < 0.5:
        other = _below(current.sensor.shape[1])
    else:
        then = _below(steps)
    mine, its = current.sensor[step, uav], current.sensor[then, other]
    if mine == its or then < tables.fixed[other]:
        return False
    new.sensor[step, uav], new.sensor[then, other] = its, mine
    nowhere = len(tables.start) - 1
    if its != nowhere and not _within(tables, new, step, uav, its):
        return False
    return mine == nowhere or _within(tables, new, then, other, mine)


@inlined
def _velocity(tables: Tables, uav: int, now: int) -> int:
    """Draw an allowed velocity that the UAV reaches: a near one, the highest, or any."""
    count, kind = tables.speeds[uav], np.random.random()
    if kind < _ANY_VELOCITY:
        return int(tables.velocities[_below(count)])
    if kind < _HIGHEST_VELOCITY:
        return int(tables.velocities[count - 1])
    place = 0
    while place < count - 1 and tables.velocities[place] < now:
        place += 1
    away = 1 + _below(_NEAR_VELOCITY)
    place += away if np.random.random() < 0.5 else -away
    return int(tables.velocities[min(max(place, 0), count - 1)])


@inlined
def _propose_velocity(
    tables: Tables, current: CurrentPlan, new: Proposal, step: int, uav: int, temperature: float, kind: float
) -> bool:
    """Draw another velocity of a UAV: for one step, with the opposite change at a later one, or for some steps."""
    steps, drawn = len(current.sensor), _velocity(tables, uav, current.velocity[step, uav])
    more = drawn - current.velocity[step, uav]
    new.velocity[step, uav] = drawn
    if kind < _RUN:
        for then in range(step + 1, step + 1 + _below(steps - step)):
            new.velocity[then, uav] = drawn
    elif more == 0:
        return False
    elif kind >= _SINGLE:
        if step + 1 >= steps:
            return False
        then = step + 1 + _below(steps - step - 1)
        new.velocity[then, uav] -= more
        allowed = False
        for level in range(tables.speeds[uav]):
            allowed = allowed or tables.velocities[level] == new.velocity[then, uav]
        if not allowed:
            return False
    nowhere, place = len(tables.start) - 1, current.place[step, uav] - current.velocity[step, uav]
    anew = _ANEW if np.random.random() < _ANEW else 0.0
    changed = False
    for then in range(step, steps):
        place += new.velocity[then, uav]
        if place == current.place[then, uav]:
            continue
        new.place[then, uav], changed = place, True
        j = new.sensor[then, uav]
        if j == nowhere or np.random.random() < anew or not _within(tables, new, then, uav, j):
            _redraw(tables, current, new, then, uav, temperature, 0.0)
    return changed


@compiled
def _anneal(
    tables: Tables,
    current: CurrentPlan,
    new: Proposal,
    best: IntArray,
    least: float,
    first: int,
    last: int,
    hot: float,
    falls: float,
    seed: int,
) -> float:
    """Search from step ``first`` to ``last``; write the best plan's actions and return its cost.

    The temperature is ``hot`` at step 0 and falls by the factor ``falls`` a step.
    """
    np.random.seed(seed)
    steps, uavs = current.sensor.shape
    temperature = hot * falls**first
    for change in range(first, last):
        if change % _SAME_TEMPERATURE == 0:
            temperature = hot * falls**change
        uav, step = _below(uavs), _below(steps)
        if step < tables.fixed[uav]:
            continue
        copy(current, new)
        kind = np.random.random()
        if kind < _SENSOR:
            _redraw(tables, current, new, step, uav, temperature, 0.0)
            if new.sensor[step, uav] == current.sensor[step, uav]:
                continue
        elif not _propose(tables, current, new, step, uav, temperature, kind):
            continue
        more = gain(tables, current, new)
        if kind >= _SENSOR and more > 0.0 and np.random.random() >= np.exp(-more / temperature):
            continue
        accept(tables, current, new)
        cost = total(current.cost)
        if cost < least - 1e-6:
            least = cost
            for row in range(steps):
                for column in range(uavs):
                    best[row, column, 0] = current.sensor[row, column]
                    best[row, column, 1] = current.velocity[row, column]
    return least


@compiled
def _settle(tables: Tables, current: CurrentPlan, new: Proposal, best: IntArray) -> float:
    """Of equal savings, collect the most packets in each step; write the sensors and return the plan's cost."""
    steps, uavs = current.sensor.shape
    for step in range(steps):
        for uav in range(uavs):
            if step < tables.fixed[uav]:
                continue
            copy(current, new)
            _redraw(tables, current, new, step, uav, 1e-9, _PACKET)
            if new.sensor[step, uav] != current.sensor[step, uav] and gain(tables, current, new) <= _PACKET:
                accept(tables, current, new)
            best[step, uav, 0] = current.sensor[step, uav]
    return total(current.cost)


class Annealing:
    """The search for one problem's plan, over links that may be uncertain. Batteries are assumed to last.

    Args:
        problem: with ``chains``.
    """

    def __init__(self, problem: FleetProblem) -> None:
        self._tables = Tables.of(problem)

    def priced(self, actions: IntArray) -> Found:
        """The expected loss of actions ``(H, I, 2)``."""
        current, _ = self._start(actions)
        return Found(actions, float(current.cost.sum()))

    def _start(self, actions: IntArray) -> tuple[CurrentPlan, Proposal]:
        current, new = CurrentPlan.empty(self._tables), Proposal.empty(self._tables)
        current.sensor[:], current.velocity[:] = actions[:, :, 0], actions[:, :, 1]
        begin(self._tables, current, new)
        return current, new

    def search(self, start: IntArray, hot: float, number: int = 0, until: float = math.inf, times: int = 1) -> Found:
        """The best actions of one run, at least as good as its start. Threads may search at a time.

        Args:
            start: shape ``(H, I, 2)``, beginning with the problem's fixed actions.
            hot: the initial temperature, packets; the final one is 0.01.
            number: of the run, which seeds its changes.
            until: a time of ``time.perf_counter`` at which the run ends; its plan then depends on the machine.
            times: the run makes so many times 5,000 changes.
        """
        (current, new), changes = self._start(start), times * CHANGES
        least, best = float(current.cost.sum()), start.copy()
        falls = (_COLD / hot) ** (1.0 / changes)
        for first in range(0, changes, _AT_ONCE):
            if time.perf_counter() > until:
                break
            last, seed = min(first + _AT_ONCE, changes), changes * number + first
            least = _anneal(self._tables, current, new, best, least, first, last, hot, falls, seed)
        current, new = self._start(best)
        return Found(best, _settle(self._tables, current, new, best))


def warm_up() -> None:
    """Compile the search, or load what an earlier process has compiled, in advance."""
    nothing, once = np.zeros(2), Arriving(np.zeros((1, 2)), np.zeros((1, 2)))
    world = Scenario(name="smallest", sensors=1, uavs=1, steps=1, max_velocity=1)
    problem = FleetProblem(
        scenario=world,
        trajectories=trajectories(world),
        progress_m=np.zeros(1),
        places=np.zeros((2, 2)),
        queue=np.zeros(2, dtype=np.int64),
        battery=nothing,
        arrivals=np.zeros((1, 2), dtype=np.int64),
        chains=queue_chains(nothing, nothing, Arriving(nothing, nothing), once, once, 1, nothing, nothing),
    )
    Annealing(problem).search(np.zeros((1, 1, 2), dtype=np.int64), 1.0)
