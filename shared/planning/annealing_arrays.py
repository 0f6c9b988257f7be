"""The arrays of :mod:`shared.planning.annealing`: of one problem, of the current plan and of a changed plan."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from shared.planning.fleet_problem import FleetProblem
from shared.planning.queue_chains import Floats
from shared.world.channel import IntArray

# Levels of a queue: those of queue_chains.py, padded with unused levels, because processors add 4, 8 or 16 numbers at
# once.
LEVELS = 32
# Arrivals of a lower probability are left out.
_NEXT_TO_NOTHING = 1e-7
# As :attr:`Tables.emptied`.
_EMPTIED = np.tri(LEVELS, dtype=np.float32) - np.eye(1, LEVELS, dtype=np.float32)


def _numbers(*shape: int) -> IntArray:
    return np.zeros(shape, dtype=np.int64)


def _floats(*shape: int) -> Floats:
    return np.zeros(shape, dtype=np.float32)


class Tables(NamedTuple):
    """One problem of U UAVs, J sensors and H steps; C places are the sums of velocities, Q = 32 levels of a queue.

    Attributes:
        moved: shape ``(U, 1 or H, C, J)``, the levels that a transfer moves.
        chance: of the same shape, the probability that its link works.
        start: shape ``(J, Q)``, the odds of each level before the first step.
        arrive: shape ``(H, J, Q)``, of a step's arrivals, in levels.
        counted: shape ``(H, J)``, the number of these that are not negligible.
        fills: shape ``(H, J, Q)``, the probability that a step's arrivals fill the queue, by the level before them.
        top: shape ``()``, the level of a full queue.
        lost: shape ``(H, J, Q)``, the packets that a step is expected to lose.
        ends: shape ``(K, J, Q)``, those after the horizon, by stage.
        stages: shape ``(U, C, J)``; the lowest of all UAVs counts.
        usable: shape ``(H, J)``.
        velocities: shape ``(V,)``, those allowed, rising; ``speeds``, shape ``(U,)``, the number that each UAV reaches.
        fixed: shape ``(U,)``, the number of each UAV's first actions that stay.
        reached: shape ``(U, 1 or H, C, R)``, the sensors in reach, and after them -1.
        late: shape ``(H + 1, H + 1, J)``, or empty.
        emptied: shape ``(Q, Q)``, by the levels of a transfer, 1 for the nonzero levels that it empties.
    """

    moved: IntArray
    chance: Floats
    start: Floats
    arrive: Floats
    counted: IntArray
    fills: Floats
    top: IntArray
    lost: Floats
    ends: Floats
    stages: IntArray
    usable: NDArray[np.bool_]
    velocities: IntArray
    speeds: IntArray
    fixed: IntArray
    reached: IntArray
    late: Floats
    emptied: Floats

    @classmethod
    def of(cls, problem: FleetProblem) -> Self:
        """The tables of a problem with ``chains``."""
        assert problem.chains is not None
        chains = problem.chains
        levels = chains.start.shape[1]
        spare = (0, LEVELS - levels)
        moved, chance = _links(problem, levels - 1)
        no_stages = np.zeros((problem.uavs, moved.shape[2], problem.sensors), dtype=np.int64)
        late = np.empty((0, 0, problem.sensors)) if problem.late is None else problem.late
        everywhere = np.ones((problem.horizon, problem.sensors), dtype=np.bool_)
        # By the level before the arrivals: the probability that they fill the queue.
        at_least = chains.arrive[..., ::-1].cumsum(axis=-1, dtype=np.float64)
        counted = np.count_nonzero(at_least > _NEXT_TO_NOTHING, axis=-1)
        return cls(
            moved=moved,
            chance=chance,
            start=np.pad(chains.start, ((0, 0), spare)),
            arrive=np.pad(chains.arrive, ((0, 0), (0, 0), spare)),
            counted=counted,
            fills=np.pad(at_least.astype(np.float32), ((0, 0), (0, 0), spare)),
            top=np.asarray(levels - 1),
            lost=np.pad(chains.lost, ((0, 0), (0, 0), spare)),
            ends=np.pad(chains.after, ((0, 0), (0, 0), spare)),
            stages=no_stages if problem.stages is None else np.stack(problem.stages),
            usable=everywhere if problem.usable is None else problem.usable,
            velocities=problem.levels,
            speeds=problem.reached,
            fixed=np.array([len(problem.fixed.get(uav, ())) for uav in range(problem.uavs)]),
            reached=listed(moved > 0),
            late=late.astype(np.float32),
            emptied=_EMPTIED,
        )


class CurrentPlan(NamedTuple):
    """The current plan's actions, and the expectations for each sensor under them.

    Attributes:
        sensor: shape ``(H, U)``; J - 1 is nowhere.
        velocity: shape ``(H, U)``.
        place: shape ``(H, U)``, the sum of velocities after each step.
        odds: shape ``(J, H + 1, 3 Q)``, before each step and after the last; before and after the levels zeros.
        paid: shape ``(J, H + 1)``, the losses before each step and before the end.
        behind: shape ``(J, H, 2 Q)``, the losses to come, after each step's transfers; before the levels those of an
            empty queue.
        known, unknown: shape ``(J,)``: ``odds`` and ``paid`` are up to date before the steps up to ``known``, and
            ``behind`` after those from ``unknown`` on.
        stage: shape ``(J,)``.
        cost: shape ``(J,)``, packets.
    """

    sensor: IntArray
    velocity: IntArray
    place: IntArray
    odds: Floats
    paid: Floats
    behind: Floats
    known: IntArray
    unknown: IntArray
    stage: IntArray
    cost: Floats

    @classmethod
    def empty(cls, tables: Tables) -> Self:
        """Empty arrays for a problem's plans."""
        (steps, sensors, width), uavs = tables.lost.shape, len(tables.fixed)
        sensor, velocity, place = (_numbers(steps, uavs) for _ in range(3))
        odds, paid = _floats(sensors, steps + 1, 3 * width), _floats(sensors, steps + 1)
        known, unknown, stage = (_numbers(sensors) for _ in range(3))
        behind, cost = _floats(sensors, steps, 2 * width), _floats(sensors)
        return cls(sensor, velocity, place, odds, paid, behind, known, unknown, stage, cost)


class Proposal(NamedTuple):
    """A changed plan, as far as it differs from the current plan; each change overwrites it.

    Attributes:
        sensor, velocity, place: as of :class:`CurrentPlan`.
        stage, cost: as of :class:`CurrentPlan`, of the sensors touched.
        first, last: shape ``(J,)``, the first and the last changed step of each sensor touched, else H and -1; H is
            after the horizon.
        odds: shape ``(2, 3 Q)``, for computing; before and after the levels zeros.
        value: shape ``(2 Q,)``, for computing.
        terms: shape ``(Q,)``, for computing.
    """

    sensor: IntArray
    velocity: IntArray
    place: IntArray
    stage: IntArray
    cost: Floats
    first: IntArray
    last: IntArray
    odds: Floats
    value: Floats
    terms: Floats

    @classmethod
    def empty(cls, tables: Tables) -> Self:
        """Empty arrays for changes of a problem's plans."""
        (steps, sensors, width), uavs = tables.lost.shape, len(tables.fixed)
        sensor, velocity, place = (_numbers(steps, uavs) for _ in range(3))
        stage, first, last = (_numbers(sensors) for _ in range(3))
        odds, value, terms = _floats(2, 3 * width), _floats(2 * width), _floats(width)
        return cls(sensor, velocity, place, stage, _floats(sensors), first, last, odds, value, terms)


def _links(problem: FleetProblem, most: int) -> tuple[IntArray, Floats]:
    """The levels that transfers move, at most ``most``, and their chances, ``(U, 1 or H, C, J)``."""
    assert problem.chains is not None
    sums = np.arange(problem.horizon * problem.scenario.max_velocity + 1)
    same = problem.links is None or all(len(table) == 1 for table in problem.links)
    steps = range(1 if same else problem.horizon)
    packets = np.array([[problem.packets(uav, sums, step) for step in steps] for uav in range(problem.uavs)])
    chance = np.array([[problem.chance(uav, sums, step) for step in steps] for uav in range(problem.uavs)])
    moved = np.clip(np.rint(packets / problem.chains.level), packets > 0, most).astype(np.int64)
    return moved, np.where(packets > 0, chance, 0.0).astype(np.float32)


def listed(within: NDArray[np.bool_]) -> IntArray:
    """The indices of the true entries on the last axis, in order, padded with -1 to the largest count."""
    count = within.sum(axis=-1)
    order = np.argsort(~within, axis=-1, kind="stable")[..., : max(int(count.max()), 1)]
    return np.where(np.arange(order.shape[-1]) < count[..., None], order, -1)
