"""The fewest packets that a large fleet could lose, by linear programming, and the planner's losses beside it.

    python -m lab.benchmarks.fleet_bound
    python -m lab.benchmarks.fleet_bound --scenario long_pipeline --worlds 3

`aicvds bound` proves nothing for `dense` in minutes. This bound knows all arrivals too, and relaxes the rest: a UAV may
be at several places of its way in shares that sum to 1, and so visit several sensors in shares; within a cell of its
way, some tens of metres, it has the best link of the cell to each sensor; batteries last. No fleet loses less. The
shares move along the way as a whole does: of two distributions, each quantile of the later one is at most a step at
full speed ahead, which is what sums of the shares up to each place have to obey (a monotone coupling).

`mpc` is the planner on board, which sees beacons alone; `longest_queue_fast` the longest queue at full speed.
`long_pipeline` has 400 sensors along 200 km and 20 UAVs that each fly up and down 10 km of it. It prints the bound, the
losses and their excess over the bound, with 95% bootstrap intervals over worlds, and writes a CSV line for each world
and scheme. A world of `dense` takes some minutes.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from scipy.optimize import linprog
from scipy.sparse import csr_array

from lab.benchmarks.gain_traces import AtFullSpeed
from lab.experiments.intervals import interval
from shared.planning.fleet_problem import FleetProblem
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario, scenario_named
from simulator.bound.clairvoyant_bound import true_problem
from simulator.flying.flight import rollout
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.policies.registry import Policy
from simulator.sites.site import Site

LENGTH_M, UAVS, SENSORS = 200_000.0, 20, 400
# The lines of the pipeline's corners, metres from the area's lower edge, so that it is no straight line.
_BENDS_M = (20_000.0, 60_000.0, 25_000.0, 70_000.0, 40_000.0)
# The objective is exact to this many packets.
_EXACT = 1e-3


@dataclass(frozen=True)
class FleetBound:
    """Compare the planner with the bound."""

    scenario: str = "dense"
    """`dense`, `long_pipeline`, or another one."""
    worlds: int = 10
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 500
    """The first seed."""
    cell: int = 14
    """Length of a cell, as a sum of velocities in m/s: smaller ones give a higher bound, and take longer."""
    out: Path = Path("runs/fleet_bound.csv")
    """Where to write each world's values."""


def long_pipeline() -> Scenario:
    """A pipeline of 200 km with 400 sensors, and 20 UAVs that share it."""
    x = np.linspace(1000.0, 180_000.0, 1000)
    corners = np.linspace(x[0], x[-1], len(_BENDS_M))
    line = np.stack((x, np.interp(x, corners, _BENDS_M)), axis=1)
    line *= LENGTH_M / np.hypot(*np.diff(line, axis=0).T).sum()
    ends = [line[round(share * (len(line) - 1))] for share in np.linspace(0.0, 1.0, UAVS + 1)]
    routes = tuple(tuple((float(p[0]), float(p[1])) for p in pair) for pair in pairwise(ends))
    bends = line[np.linspace(0, len(line) - 1, 200).round().astype(int)]
    return Scenario(
        name="long_pipeline",
        sensors=SENSORS,
        uavs=UAVS,
        area_m=float(np.ceil(line.max())),
        layout="pipeline",
        pipeline=tuple((float(x), float(y)) for x, y in bends),
        routes=routes,
        arrival_rate_min=0.2,
        arrival_rate_max=0.8,
        steps=60,
    )


class _Rows:
    """Sparse rows ``A x`` with their limits, collected."""

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray[Any], NDArray[Any], FloatArray]] = []
        self._limits: list[FloatArray] = []
        self._count = 0

    def add(self, limits: NDArray[Any], *terms: tuple[NDArray[Any], NDArray[Any], ArrayLike]) -> None:
        """Add a row for each limit; each term has the rows (from 0 on), the variables, and their factors."""
        for rows, variables, factors in terms:
            spread = np.broadcast_to(np.asarray(factors, dtype=float), variables.shape)
            self._parts.append((rows.ravel() + self._count, variables.ravel(), spread.ravel()))
        self._limits.append(np.asarray(limits, dtype=float).ravel())
        self._count += limits.size

    def made(self, variables: int) -> tuple[Any, FloatArray]:
        """The matrix and the limits."""
        rows, columns, factors = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return csr_array((factors, (rows, columns)), shape=(self._count, variables)), np.concatenate(self._limits)


class _Visits(NamedTuple):
    """The visits that are possible, each with its UAV, step, cell and sensor, and the packets of the best link."""

    uav: IntArray
    step: IntArray
    cell: IntArray
    sensor: IntArray
    packets: IntArray

    @classmethod
    def of(cls, problem: FleetProblem, cell: int) -> _Visits:
        """Those of a problem's plans."""
        steps, top = problem.horizon, problem.scenario.max_velocity
        cells = steps * top // cell + 1
        sums, found = np.minimum(np.arange(cells * cell), steps * top), []
        for uav in range(problem.uavs):
            for step in range(steps):
                packets = np.minimum(problem.packets(uav, sums, step), problem.scenario.queue_capacity)
                best = packets.reshape(cells, cell, -1).max(axis=1)
                at, sensor = np.nonzero(best[: top * (step + 1) // cell + 1])
                found.append((np.full_like(at, uav), np.full_like(at, step), at, sensor, best[at, sensor]))
        return cls(*(np.concatenate(part) for part in zip(*found, strict=True)))


def relaxed(problem: FleetProblem, cell: int) -> float:
    """The fewest packets lost in the relaxation.

    Raises:
        RuntimeError: the solver found no optimum.
    """
    steps, uavs, sensors, top = problem.horizon, problem.uavs, problem.sensors, problem.scenario.max_velocity
    visits, cells, capacity = _Visits.of(problem, cell), steps * top // cell + 1, problem.scenario.queue_capacity
    sizes = (uavs * steps * cells, *(steps * sensors,) * 3, len(visits.uav))
    # By UAV, step and cell the sum of the shares up to this cell; by step and sensor the packets moved, in the queue
    # after the step, and lost; the visits.
    up_to, moved, queue, lost, visit = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    up_to = up_to.reshape(uavs, steps, cells)
    place, every = visits.step * sensors + visits.sensor, np.arange(steps * sensors)
    rows = _Rows()
    _add_ways(rows, up_to, math.ceil(top / cell))
    # Together the visits from a cell have at most the share there, and those to a sensor at most 1.
    shares = np.arange(up_to.size).reshape(up_to.shape)
    of_visit = shares[visits.uav, visits.step, visits.cell]
    rows.add(
        np.zeros(up_to.size), (of_visit, visit, 1.0), (shares, up_to, -1.0), (shares[..., 1:], up_to[..., :-1], 1.0)
    )
    rows.add(np.ones(steps * sensors), (place, visit, 1.0))
    # The packets moved are at most those of the visits' links, and those that are there.
    before = np.concatenate((problem.queue, np.zeros((steps - 1) * sensors)))
    rows.add(np.zeros(steps * sensors), (every, moved, 1.0), (place, visit, -visits.packets))
    rows.add(before, (every, moved, 1.0), (every[sensors:], queue[:-sensors], -1.0))
    # queue = before - moved + arrivals - lost
    equal = _Rows()
    parts = ((every, queue, 1.0), (every[sensors:], queue[:-sensors], -1.0), (every, moved, 1.0), (every, lost, 1.0))
    equal.add(before + problem.arrivals.ravel(), *parts)
    limits = np.stack((np.zeros(sum(sizes)), np.full(sum(sizes), np.inf)))
    limits[1, queue], limits[1, up_to] = capacity, 1.0
    for step in range(steps):
        # By now a UAV is somewhere that it can have reached.
        limits[0, up_to[:, step, min(top * (step + 1) // cell, cells - 1) :]] = 1.0
    costs, solve = np.zeros(sum(sizes)), cast(Any, linprog)
    costs[lost] = 1.0
    found = solve(costs, *rows.made(sum(sizes)), *equal.made(sum(sizes)), bounds=limits.T, method="highs-ipm")
    if not found.success:
        raise RuntimeError(found.message)
    return float(found.fun)


def _add_ways(rows: _Rows, up_to: IntArray, reach: int) -> None:
    """Along the cells shares rise; a step moves each of them on by 0 to ``reach`` cells."""
    later, now = up_to[:, 1:], up_to[:, :-1]
    for less, more in (
        (up_to[..., :-1], up_to[..., 1:]),
        (later, now),
        (now[..., :-reach], later[..., reach:]),
    ):
        count = np.arange(less.size).reshape(less.shape)
        rows.add(np.zeros(less.size), (count, less, 1.0), (count, more, -1.0))


def least(site: Site, seed: int, cell: int) -> int:
    """The bound of one world.

    Raises:
        ValueError: the world has wind, which carries a UAV further than its velocity.
    """
    if site.scenario.wind_mps or site.scenario.gust_mps:
        raise ValueError(f"scenario {site.scenario.name}: in wind this is no bound")
    world = site.world()
    world.reset(seed=seed)
    found = relaxed(true_problem(world), cell)
    return max(0, math.ceil(found - _EXACT * (1.0 + found)))


def flown(scenario: Scenario, seed: int, cell: int) -> dict[str, int]:
    """The bound and the packets that each policy loses in one world."""
    lost = {"bound": least(Site(scenario), seed, cell)}
    policies: dict[str, Policy] = {"mpc": RecedingHorizonPolicy(), "longest_queue_fast": AtFullSpeed("longest_queue")}
    for name, policy in policies.items():
        world = Site(scenario).world()
        world.reset(seed=seed)
        lost[name] = sum(int(step.lost_packets) for step in rollout(world, policy, seed))
    return lost


def main(args: FleetBound) -> int:
    """Prove, fly, print, write."""
    console = Console(highlight=False)
    scenario = long_pipeline() if args.scenario == "long_pipeline" else scenario_named(args.scenario)
    seeds = range(args.first, args.first + args.worlds)
    found = []
    for seed in seeds:
        found.append(flown(scenario, seed, args.cell))
        console.print(f"seed {seed}: {', '.join(f'{name} {lost}' for name, lost in found[-1].items())}")
    for name in found[0]:
        lost, excess = (interval([float(one[name] - less * one["bound"]) for one in found]) for less in (0, 1))
        text = f"{name}: {lost.mean:.0f} [{lost.low:.0f}, {lost.high:.0f}]"
        console.print(f"{text}, {excess.mean:.0f} [{excess.low:.0f}, {excess.high:.0f}] above the bound")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["scenario", "scheme", "seed", "lost_packets"])
        for seed, one in zip(seeds, found, strict=True):
            writer.writerows([scenario.name, name, seed, lost] for name, lost in one.items())
    console.print(f"Wrote {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(FleetBound, description=__doc__)))
