"""The expected losses of a plan, compiled: the costs of :mod:`shared.planning.annealing`.

Sensors lose packets independently of each other. So the odds of each sensor's queue before every step are kept, and the
losses expected after every step, and a changed visit costs one product of the two.
"""

import numpy as np

from shared.kit.compiled import compiled, inlined
from shared.planning.annealing_arrays import LEVELS, CurrentPlan, Proposal, Tables
from shared.planning.queue_chains import Floats
from shared.world.channel import IntArray


@inlined
def _set(one: Floats, other: Floats) -> None:
    """Write an array over another."""
    for q in range(len(one)):
        one[q] = other[q]


@inlined
def dot(one: Floats, other: Floats, terms: Floats) -> np.float32:
    """The product of two arrays ``(Q,)``, summed in the same order on every machine.

    Only loops over whole arrays become vector instructions, so the terms ``(Q,)`` are written before they are summed.
    """
    for q in range(len(terms)):
        terms[q] = one[q] * other[q]
    part = len(terms) // 4
    for q in range(part):
        terms[q] = (terms[q] + terms[q + part]) + (terms[q + 2 * part] + terms[q + 3 * part])
    even, odd = (terms[0] + terms[4]) + (terms[2] + terms[6]), (terms[1] + terms[5]) + (terms[3] + terms[7])
    return np.float32(even + odd)


@inlined
def total(cost: Floats) -> float:
    """The sum of costs ``(J,)``."""
    total = 0.0
    for j in range(len(cost)):
        total += cost[j]
    return total


@inlined
def _serve(tables: Tables, new: Proposal, odds: Floats, levels: int, chance: np.float32) -> None:
    """Change the odds ``(3 Q,)`` by a transfer of this many levels over a link of this chance."""
    before, ahead = odds[LEVELS:], odds[LEVELS + levels :]
    emptied = dot(before, tables.emptied[levels], new.terms)
    for q in range(len(new.terms)):
        new.terms[q] = before[q] + chance * (ahead[q] - before[q])
    new.terms[0] = before[0] + chance * emptied
    _set(before[:LEVELS], new.terms)


@inlined
def visited(
    new: Proposal, odds: Floats, behind: Floats, idle: np.float32, levels: int, chance: np.float32
) -> np.float32:
    """The losses to come after a transfer, from the odds before it; ``idle`` are those without it."""
    moved = dot(odds, behind[LEVELS - levels :], new.terms)
    return np.float32(idle + chance * (moved - idle))


@inlined
def moving(odds: Floats, levels: int, chance: np.float32) -> float:
    """The levels that a transfer is expected to move."""
    moved = 0.0
    for q in range(LEVELS):
        moved += odds[q] * min(q, levels)
    return float(moved * chance)


@inlined
def _arrive(tables: Tables, new: Proposal, step: int, j: int, odds: Floats, after: Floats) -> None:
    """Write the odds ``(3 Q,)`` after a step's arrivals."""
    arrive, top, then = tables.arrive[step, j], tables.top[()], after[LEVELS:]
    for q in range(len(arrive)):
        then[q] = 0.0
    # Four terms at a time, so that the sums are read and written less often.
    for a in range(0, tables.counted[step, j], 4):
        none, one = odds[LEVELS - a :], odds[LEVELS - a - 1 :]
        two, three = odds[LEVELS - a - 2 :], odds[LEVELS - a - 3 :]
        p, r, s, t = arrive[a], arrive[a + 1], arrive[a + 2], arrive[a + 3]
        for q in range(len(arrive)):
            then[q] += (p * none[q] + r * one[q]) + (s * two[q] + t * three[q])
    full = dot(odds[LEVELS:], tables.fills[step, j], new.terms)
    for q in range(top, len(arrive)):
        then[q] = 0.0
    then[top] = full


@inlined
def _before_arrivals(tables: Tables, step: int, j: int, value: Floats, before: Floats) -> None:
    """Write the expected losses by the level ``(Q,)`` before a step's arrivals, from those after them."""
    arrive, lost, top = tables.arrive[step, j], tables.lost[step, j], tables.top[()]
    for q in range(top, len(value)):
        value[q] = value[top]
    _set(before[:LEVELS], lost)
    for a in range(0, tables.counted[step, j], 4):
        none, one, two, three = value[a:], value[a + 1 :], value[a + 2 :], value[a + 3 :]
        p, r, s, t = arrive[a], arrive[a + 1], arrive[a + 2], arrive[a + 3]
        for q in range(len(arrive)):
            before[q] += (p * none[q] + r * one[q]) + (s * two[q] + t * three[q])


@inlined
def _visitor(tables: Tables, sensor: IntArray, place: IntArray, step: int, j: int) -> tuple[int, np.float32]:
    """The levels that the step's visit of a sensor moves, and its chance; 0 without a visit."""
    for uav in range(sensor.shape[1]):
        if sensor[step, uav] == j:
            at = min(step, tables.moved.shape[1] - 1)
            levels = tables.moved[uav, at, place[step, uav], j]
            if levels > 0:
                return levels, tables.chance[uav, at, place[step, uav], j]
    return 0, np.float32(0.0)


@inlined
def lateness(tables: Tables, sensor: IntArray, place: IntArray, j: int) -> np.float32:
    """The price of a sensor's overdue visits under some actions."""
    late, total = tables.late, np.float32(0.0)
    for end in range(len(late)):
        price = late[0, end, j]
        for step in range(min(end + 1, len(sensor))):
            levels, chance = _visitor(tables, sensor, place, step, j)
            if levels:
                price -= chance * (price - late[step + 1, end, j])
        total += price
    return total


@inlined
def _cost(tables: Tables, current: CurrentPlan, new: Proposal, j: int) -> np.float32:
    """The cost of a sensor whose visits of its first to its last changed step are the proposal's."""
    steps, first, last = len(tables.lost), new.first[j], new.last[j]
    know_odds(tables, current, new, j, first)
    if last < steps:
        know_behind(tables, current, new, j, last)
    odds, after = new.odds[0], new.odds[1]
    _set(odds, current.odds[j, first])
    paid = current.paid[j, first]
    late = lateness(tables, new.sensor, new.place, j) if len(tables.late) else np.float32(0.0)
    for step in range(first, steps):
        levels, chance = _visitor(tables, new.sensor, new.place, step, j)
        if step == last:
            behind = current.behind[j, step]
            idle = dot(odds[LEVELS:], behind[LEVELS:], new.terms)
            if levels:
                idle = visited(new, odds[LEVELS:], behind, idle, levels, chance)
            return np.float32(late + paid + idle)
        if levels:
            _serve(tables, new, odds, levels, chance)
        paid += dot(odds[LEVELS:], tables.lost[step, j], new.terms)
        _arrive(tables, new, step, j, odds, after)
        odds, after = after, odds
    return np.float32(late + paid + dot(odds[LEVELS:], tables.ends[new.stage[j], j], new.terms))


@inlined
def know_odds(tables: Tables, current: CurrentPlan, new: Proposal, j: int, until: int) -> None:
    """Compute a sensor's odds and losses before each step, up to this one, where they are not known."""
    for step in range(current.known[j], until):
        odds = new.odds[0]
        _set(odds, current.odds[j, step])
        levels, chance = _visitor(tables, current.sensor, current.place, step, j)
        if levels:
            _serve(tables, new, odds, levels, chance)
        current.paid[j, step + 1] = current.paid[j, step] + dot(odds[LEVELS:], tables.lost[step, j], new.terms)
        _arrive(tables, new, step, j, odds, current.odds[j, step + 1])
    current.known[j] = max(current.known[j], until)


@inlined
def know_behind(tables: Tables, current: CurrentPlan, new: Proposal, j: int, first: int) -> None:
    """Compute a sensor's losses to come after each step from this one on, where they are not known."""
    steps, value = len(tables.lost), new.value
    for step in range(current.unknown[j] - 1, first - 1, -1):
        if step == steps - 1:
            _set(value[:LEVELS], tables.ends[current.stage[j], j])
        else:
            levels, chance = _visitor(tables, current.sensor, current.place, step + 1, j)
            stays, moves = current.behind[j, step + 1, LEVELS:], current.behind[j, step + 1, LEVELS - levels :]
            for q in range(len(stays)):
                value[q] = stays[q] + chance * (moves[q] - stays[q])
        behind, empty = current.behind[j, step, LEVELS:], current.behind[j, step, :LEVELS]
        _before_arrivals(tables, step, j, value, behind)
        for q in range(len(empty)):
            empty[q] = behind[0]
    current.unknown[j] = min(current.unknown[j], first)


@compiled
def begin(tables: Tables, current: CurrentPlan, new: Proposal) -> None:
    """Compute the current plan's places, stages and costs from its sensors and velocities."""
    steps, uavs = current.sensor.shape
    for uav in range(uavs):
        summed = 0
        for step in range(steps):
            summed += current.velocity[step, uav]
            current.place[step, uav] = summed
    for j in range(len(current.cost)):
        current.stage[j] = _stage(tables, current.place, j)
        current.known[j], current.unknown[j] = 0, steps
        current.paid[j, 0] = 0.0
        _set(current.odds[j, 0, LEVELS : 2 * LEVELS], tables.start[j])
        know_odds(tables, current, new, j, steps)
        current.cost[j] = current.paid[j, steps] + dot(
            current.odds[j, steps, LEVELS:], tables.ends[current.stage[j], j], new.terms
        )
        if len(tables.late):
            current.cost[j] += lateness(tables, current.sensor, current.place, j)


@inlined
def _stage(tables: Tables, place: IntArray, j: int) -> int:
    """A sensor's stage after the horizon."""
    lowest = len(tables.ends) - 1
    for uav in range(place.shape[1]):
        lowest = min(lowest, tables.stages[uav, place[-1, uav], j])
    return lowest


@inlined
def _touch(new: Proposal, j: int, step: int) -> None:
    new.first[j] = min(new.first[j], step)
    new.last[j] = max(new.last[j], step)


@inlined
def gain(tables: Tables, current: CurrentPlan, new: Proposal) -> np.float32:
    """The cost of a proposal above the current plan's; it writes the costs of the sensors touched."""
    steps, uavs = current.sensor.shape
    nowhere = len(tables.start) - 1
    for j in range(nowhere):
        new.first[j] = steps
        new.last[j] = -1
    ends = False
    for step in range(steps):
        for uav in range(uavs):
            before, now = current.sensor[step, uav], new.sensor[step, uav]
            if before != now or current.place[step, uav] != new.place[step, uav]:
                if before != nowhere:
                    _touch(new, before, step)
                if now != nowhere:
                    _touch(new, now, step)
    for uav in range(uavs):
        ends = ends or current.place[-1, uav] != new.place[-1, uav]
    total = np.float32(0.0)
    for j in range(nowhere):
        new.stage[j] = current.stage[j]
        if ends:
            new.stage[j] = _stage(tables, new.place, j)
            if new.stage[j] != current.stage[j]:
                _touch(new, j, steps)
        if new.last[j] >= 0:
            new.cost[j] = _cost(tables, current, new, j)
            total += new.cost[j] - current.cost[j]
    return total


@inlined
def copy(current: CurrentPlan | Proposal, new: CurrentPlan | Proposal) -> None:
    """Copy a plan's actions."""
    for step in range(current.sensor.shape[0]):
        for uav in range(current.sensor.shape[1]):
            new.sensor[step, uav] = current.sensor[step, uav]
            new.velocity[step, uav] = current.velocity[step, uav]
            new.place[step, uav] = current.place[step, uav]


@inlined
def accept(tables: Tables, current: CurrentPlan, new: Proposal) -> None:
    """Make a proposal, whose costs are computed, the current plan."""
    copy(new, current)
    for j in range(len(tables.start) - 1):
        if new.last[j] >= 0:
            current.stage[j], current.cost[j] = new.stage[j], new.cost[j]
            current.known[j] = min(current.known[j], new.first[j])
            current.unknown[j] = max(current.unknown[j], new.last[j])
