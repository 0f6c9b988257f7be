"""Plans of a fleet with the fewest lost packets over a horizon, found and bounded by CP-SAT."""

import math
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from shared.planning.fleet_problem import FleetProblem, fly
from shared.planning.greedy import look_ahead
from shared.world.channel import IntArray

# OR-Tools takes a second to import, and only planning needs it.
if TYPE_CHECKING:
    from simulator.bound.formulation import Formulation, Links

# Parameters of the solver, and the share of the work that each search gets.
_Strategies = tuple[tuple[Mapping[str, Any], float], ...]

_QUICK_WORK = 3.0
# The steps of each plan that makes a start.
_NEAR = 8
# One worker first raises the bound by cores, which is fastest if most sensors lose nothing. With many losses it finds
# no plan, and the usual search gets the rest of the work. Without a limit of work the first search never ends.
_CORES: _Strategies = (({"optimize_with_core": True}, 1 / 3), ({}, 2 / 3))
# With less work the first search proves nothing.
_WORK_FOR_CORES = 0.05
_USUAL: _Strategies = (({}, 1.0),)


@dataclass(frozen=True)
class Budget:
    """The limits of a search.

    Attributes:
        work: limit of the solver's deterministic time: about seconds on an idle core, but counted in operations, so
            that with one worker the same problem gives the same plan on a busy machine too.
        seconds: limit of the wall clock; the plan then depends on the machine.
        workers: threads.
    """

    work: float = math.inf
    seconds: float = math.inf
    workers: int = 1


@dataclass(frozen=True, eq=False)
class Plan:
    """A fleet's plan.

    Attributes:
        actions: shape ``(H, I, 2)``: sensor, velocity. A UAV with nothing to collect names a sensor that no other
            UAV's transfer needs.
        lost_packets: the packets that the actions lose over the horizon, with the real batteries and links; of a flight
            in the world those lost there.
        lower_bound: proven: no actions lose fewer, with any batteries. With ``cautious`` links it holds only if every
            link were as weak as those.
        seconds: wall clock, building included.
    """

    actions: IntArray
    lost_packets: int
    lower_bound: int = 0
    seconds: float = 0.0

    @property
    def optimal(self) -> bool:
        """Whether the plan is proven to be the best (with ``cautious`` links: if every link were so weak)."""
        return self.gap <= 0

    @property
    def gap(self) -> int:
        """Packets that the actions lose above the bound."""
        return self.lost_packets - self.lower_bound


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended a search; ``plan`` is the best plan found, and its bound holds."""

    def __init__(self, plan: Plan) -> None:
        super().__init__()
        self.plan = plan


def plan(problem: FleetProblem, budget: Budget, links: "Links" = "exact", hint: IntArray | None = None) -> Plan:
    """Search once.

    Args:
        problem: to solve.
        budget: the limits; without limits the search ends when the optimum is proven.
        links: how exactly to take the capacity of links; see :class:`~simulator.bound.formulation.Formulation`.
        hint: actions ``(H, I, 2)`` to start from, by default the greedy plan's. They become the plan unless the search
            finds better ones.

    Returns:
        The best plan found; otherwise the hint.

    Raises:
        ValueError: the problem has uncertain links or queues, guidance, or sensors or actions that are given; only
            :class:`shared.planning.annealing.Annealing` plans with these.
        ModuleNotFoundError: OR-Tools is not installed (extra ``bound``).
        Interrupted: Ctrl-C came, and the budget limits seconds.
    """
    from simulator.bound.formulation import Formulation

    for name in ("chances", "chains", "allowed", "weights", "late", "usable", "fixed"):
        if (value := getattr(problem, name)) is not None and not (name == "fixed" and not value):
            raise ValueError(f"{name}: CP-SAT plans over certain links and arrivals, without orders")
    begun = time.perf_counter()
    best = _flown(problem, look_ahead(problem) if hint is None else hint)
    for strategy, share in _CORES if budget.workers == 1 and budget.work >= _WORK_FOR_CORES else _USUAL:
        formulation = Formulation(problem, links)
        formulation.hint(best.actions)
        left = budget.seconds - (time.perf_counter() - begun)
        now = replace(budget, work=budget.work * share, seconds=max(left, 0.0))
        search = _search(formulation, now, strategy)
        better = best if search.actions is None else min(best, _flown(problem, search.actions), key=_lost)
        best = replace(better, lower_bound=max(best.lower_bound, search.lower_bound))
        if search.proven or search.interrupted:
            break
    best = replace(best, seconds=time.perf_counter() - begun)
    if search.interrupted:
        raise Interrupted(best)
    return best


def least_loss(problem: FleetProblem, seconds: float, workers: int = 8) -> Plan:
    """The plan of the fewest lost packets and the best bound that can be proven in about ``seconds``.

    The search starts from a greedy plan. It first searches quickly with uniform links, too strong for the bound and too
    weak for the plan. If bound and plan do not meet, it searches with all ``workers``, and then with exact links.

    Raises:
        Interrupted: Ctrl-C came.
    """
    begun = time.perf_counter()
    start = best = _flown(problem, look_ahead(problem))
    try:
        for best in _improved(problem, start, seconds, workers):
            if best.optimal:
                break
    except KeyboardInterrupt:
        raise Interrupted(replace(best, seconds=time.perf_counter() - begun)) from None
    return replace(best, seconds=time.perf_counter() - begun)


def _improved(problem: FleetProblem, best: Plan, seconds: float, workers: int) -> Iterator[Plan]:
    """The best plan and bound after each of several searches; Ctrl-C may interrupt the last one."""
    begun = time.perf_counter()
    quick = Budget(work=_QUICK_WORK)
    searches: list[tuple[Links, Budget, float]] = [
        ("hopeful", quick, 0.3),
        ("cautious", quick, 0.3),
        ("hopeful", Budget(workers=workers), 0.5),
        ("exact", Budget(workers=workers), 1.0),
    ]
    for links, budget, share in searches:
        if links == "cautious":
            left = seconds - (time.perf_counter() - begun)
            best = _better(best, _flown(problem, _receding(problem, left * share)), links)
            yield best
        left = seconds - (time.perf_counter() - begun)
        if left <= 0:
            return
        now = replace(budget, seconds=max(left * share, 0.01))
        try:
            found = plan(problem, now, links, best.actions)
        except Interrupted as stopped:
            yield _better(best, stopped.plan, links)
            raise
        best = _better(best, found, links)
        yield best


def _receding(problem: FleetProblem, seconds: float) -> IntArray:
    """Actions from plans of a few steps each, one after another: a start for a problem too large as a whole."""
    begun, flown = time.perf_counter(), []
    now = problem
    while True:
        near = replace(now, arrivals=now.arrivals[:_NEAR], links=now.links_until(_NEAR))
        left = seconds - (time.perf_counter() - begun)
        actions = look_ahead(near)
        if left > 0:
            actions = plan(near, Budget(work=0.3, seconds=left), "cautious", actions).actions
        kept = actions[: _NEAR // 2 if now.horizon > _NEAR else _NEAR]
        flown.append(kept)
        if len(kept) == now.horizon:
            return np.concatenate(flown)
        now = replace(
            near,
            progress_m=now.progress_m + kept[:, :, 1].sum(axis=0) * problem.scenario.step_s,
            queue=fly(near, actions).queue[len(kept)],
            arrivals=now.arrivals[len(kept) :],
            links=now.links_after(kept),
        )


def _better(best: Plan, found: Plan, links: "Links") -> Plan:
    """The better plan, with the higher of the bounds that hold in the world."""
    proven = 0 if links == "cautious" else found.lower_bound
    return replace(min(best, found, key=_lost), lower_bound=max(best.lower_bound, proven))


class _Search(NamedTuple):
    """The result of one run of the solver; ``actions`` is ``None`` if it found no plan."""

    actions: IntArray | None
    lower_bound: int
    proven: bool
    interrupted: bool


def _flown(problem: FleetProblem, actions: IntArray) -> Plan:
    """Actions as a plan without a bound."""
    return Plan(actions, int(fly(problem, actions).lost.sum()))


def _lost(plan: Plan) -> int:
    return plan.lost_packets


def _search(formulation: "Formulation", budget: Budget, strategy: Mapping[str, Any]) -> _Search:
    from ortools.sat.python import cp_model

    solver = cp_model.CpSolver()
    solver.parameters.num_workers = budget.workers
    solver.parameters.random_seed = 0
    # Probing takes longer than the search itself.
    solver.parameters.cp_model_probing_level = 0
    for name, value in strategy.items():
        setattr(solver.parameters, name, value)
    if budget.work < math.inf:
        solver.parameters.max_deterministic_time = budget.work
    if budget.seconds < math.inf:
        solver.parameters.max_time_in_seconds = budget.seconds

    # Python handles Ctrl-C, not the solver.
    solver.parameters.catch_sigint_signal = False
    status, stopped = _solved(solver, formulation.model, budget)
    actions = formulation.actions(solver.value) if status in (cp_model.OPTIMAL, cp_model.FEASIBLE) else None
    # Lost packets are whole numbers; any fraction is the solver's rounding.
    bound = max(0, math.ceil(solver.best_objective_bound - 1e-6))
    return _Search(actions, bound, status == cp_model.OPTIMAL, stopped)


def _solved(solver: Any, model: Any, budget: Budget) -> tuple[Any, bool]:
    """The solver's status, and whether Ctrl-C ended the search.

    Python handles Ctrl-C only between instructions of the main thread, so a long search runs in another thread.
    """
    if budget.seconds == math.inf:
        return solver.solve(model), False
    with ThreadPoolExecutor(1) as solving:
        search = solving.submit(solver.solve, model)
        try:
            return search.result(), False
        except KeyboardInterrupt:
            solver.stop_search()
            return search.result(), True
