"""The fewest packets that a large fleet could lose, by Lagrangian relaxation, compared with the planner's losses.

    python -m lab.benchmarks.fleet_bound
    python -m lab.benchmarks.fleet_bound --scenario long_pipeline --worlds 3

`aicvds bound` proves nothing for `dense` in minutes. This bound knows all arrivals too, and puts a price on each cell
of a UAV's way in each step, instead of the rule that a UAV collects from one sensor at a time, and where it is. At
given prices each sensor buys its cheapest visits by itself, and each UAV flies the dearest way; both are solved
exactly, by dynamic programming over queues and cells. The sensors' losses and prices less the ways' prices are a lower
bound for every fleet, at any prices (Held and Karp 1971; Fisher 1981), and subgradient steps raise it. Within a cell,
some tens of metres, a UAV has the best link of the cell to each sensor, and batteries last.

`mpc` is the planner on board, which sees beacons alone; `longest_queue_fast` the longest queue at full speed.
`long_pipeline` has 400 sensors along 200 km and 20 UAVs that each fly up and down 10 km of it. It prints the bound, the
losses and their excess over the bound, with 95% bootstrap intervals over worlds, and writes a CSV line for each world
and scheme. A world of `dense` takes a minute.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.console import Console

from lab.benchmarks.gain_traces import AtFullSpeed
from lab.experiments.intervals import interval
from shared.kit.compiled import compiled
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
# A bound that is higher than a whole number by less than this counts as that number.
_EXACT = 1e-6
# The share of the earlier direction in each change of the prices, and the rounds without a better bound after which the
# changes become half as large.
_MEMORY, _PATIENCE = 0.9, 30
# The shares of the rounds, and the axes of UAVs, steps and cells that have one price.
_PHASES: tuple[tuple[float, tuple[int, ...]], ...] = ((0.2, (0, 2)), (0.2, (2,)), (0.6, ()))


@dataclass(frozen=True)
class FleetBound:
    """Compare the planner with the bound."""

    scenario: str = "dense"
    """`dense`, `long_pipeline`, or another one."""
    worlds: int = 10
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 500
    """The first seed."""
    cell: int = 7
    """Length of a cell, as a sum of velocities in m/s: smaller ones give a higher bound, and take longer."""
    rounds: int = 3000
    """Changes of the prices."""
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


class _Visits(NamedTuple):
    """The visits that are possible, by step and sensor, each with its UAV and cell and the packets of its best link.

    Those of sensor j in step t are at ``first[t, j]`` to ``first[t, j + 1] - 1``; the last axis has one entry more.
    """

    first: IntArray
    uav: IntArray
    cell: IntArray
    packets: IntArray

    @classmethod
    def of(cls, problem: FleetProblem, cell: int) -> _Visits:
        """Those of a problem's plans."""
        steps, top, sensors = problem.horizon, problem.scenario.max_velocity, problem.sensors
        cells = steps * top // cell + 1
        sums, first = np.minimum(np.arange(cells * cell), steps * top), np.zeros((steps, sensors + 1), dtype=np.int64)
        found: list[tuple[IntArray, IntArray, IntArray]] = []
        count = 0
        for step in range(steps):
            tables = [
                np.minimum(problem.packets(u, sums, step), problem.scenario.queue_capacity) for u in range(problem.uavs)
            ]
            best = np.stack(tables).reshape(problem.uavs, cells, cell, sensors).max(axis=2)
            best[:, top * (step + 1) // cell + 1 :] = 0
            sensor, uav, at = np.nonzero(best.transpose(2, 0, 1))
            first[step] = np.searchsorted(sensor, np.arange(sensors + 1)) + count
            count += len(sensor)
            found.append((uav, at, best[uav, at, sensor]))
        return cls(first, *(np.concatenate(part) for part in zip(*found, strict=True)))


class _Scratch(NamedTuple):
    """Arrays for computing: by step and packets in the queue, and by step and cell."""

    value: FloatArray
    after: FloatArray
    choice: IntArray
    ahead: FloatArray


@compiled
def _plan_sensors(
    visits: _Visits, arrivals: IntArray, start: IntArray, prices: FloatArray, used: FloatArray, scratch: _Scratch
) -> float:
    """Each sensor's cheapest visits at these prices; counts them in ``used`` and returns their losses and prices."""
    steps, sensors = arrivals.shape
    value, after, choice = scratch.value, scratch.after, scratch.choice
    capacity, total = value.shape[1] - 1, 0.0
    for j in range(sensors):
        for step in range(steps - 1, -1, -1):
            for packets in range(capacity + 1):
                grown = packets + arrivals[step, j]
                after[packets] = max(grown - capacity, 0) + value[step + 1, min(grown, capacity)]
                value[step, packets], choice[step, packets] = after[packets], -1
            for visit in range(visits.first[step, j], visits.first[step, j + 1]):
                price, most = prices[visits.uav[visit], step, visits.cell[visit]], visits.packets[visit]
                for packets in range(1, capacity + 1):
                    cost = price + after[max(packets - most, 0)]
                    if cost < value[step, packets]:
                        value[step, packets], choice[step, packets] = cost, visit
        packets = start[j]
        total += value[0, packets]
        for step in range(steps):
            visit = choice[step, packets]
            if visit >= 0:
                used[visits.uav[visit], step, visits.cell[visit]] += 1.0
                packets = max(packets - visits.packets[visit], 0)
            packets = min(packets + arrivals[step, j], capacity)
    return total


@compiled
def _plan_ways(prices: FloatArray, reach: int, used: FloatArray, scratch: _Scratch) -> float:
    """Each UAV's way of the highest prices; takes its cells off ``used`` and returns the prices."""
    uavs, steps, cells = prices.shape
    ahead, total = scratch.ahead, 0.0
    for uav in range(uavs):
        for step in range(steps - 1, -1, -1):
            for cell in range(cells):
                most = 0.0
                if step + 1 < steps:
                    for then in range(cell, min(cell + reach, cells - 1) + 1):
                        most = max(most, ahead[step + 1, then])
                ahead[step, cell] = prices[uav, step, cell] + most
        at = 0
        for step in range(steps):
            best = at
            for then in range(at, min(at + reach, cells - 1) + 1):
                if ahead[step, then] > ahead[step, best]:
                    best = then
            if step == 0:
                total += ahead[0, best]
            at = best
            used[uav, step, at] -= 1.0
    return total


def relaxed(problem: FleetProblem, cell: int, rounds: int, known: float) -> float:
    """The best bound of ``rounds`` rounds; no fleet loses less than any of them.

    Args:
        known: packets that a flight loses, for the size of the steps.
    """
    steps, top = problem.horizon, problem.scenario.max_velocity
    visits, cells, capacity = _Visits.of(problem, cell), steps * top // cell + 1, problem.scenario.queue_capacity
    scratch = _Scratch(
        value=np.zeros((steps + 1, capacity + 1)),
        after=np.zeros(capacity + 1),
        choice=np.zeros((steps, capacity + 1), dtype=np.int64),
        ahead=np.zeros((steps, cells)),
    )
    kept, used = np.zeros((2, problem.uavs, steps, cells))
    best = 0.0
    # One price for all in each step, then one for each UAV, then one for each cell.
    for share, shared in _PHASES:
        prices, factor, stale, mean = kept.copy(), 1.0, 0, np.zeros(())
        for _ in range(round(share * rounds)):
            used[:] = 0.0
            bound = _plan_sensors(visits, problem.arrivals, problem.queue, prices, used, scratch)
            bound -= _plan_ways(prices, math.ceil(top / cell), used, scratch)
            if bound > best:
                best, stale, kept = bound, 0, prices.copy()
            elif (stale := stale + 1) == _PATIENCE:
                prices, factor, stale, mean = kept.copy(), 0.5 * factor, 0, np.zeros(())
                continue
            mean = _MEMORY * mean + (1.0 - _MEMORY) * used.sum(axis=shared, keepdims=True)
            change = factor * max(known - bound, 1.0) / max(float((mean**2).sum()), 1e-9) * mean
            prices = np.maximum(prices + change, 0.0)
    return best


def least(site: Site, seed: int, cell: int, rounds: int, known: float) -> int:
    """The bound of one world; see :func:`relaxed`.

    Raises:
        ValueError: the world has wind, which carries a UAV further than its velocity.
    """
    if site.scenario.wind_mps or site.scenario.gust_mps:
        raise ValueError(f"scenario {site.scenario.name}: in wind this is no bound")
    world = site.world()
    world.reset(seed=seed)
    # The losses are whole numbers.
    return math.ceil(relaxed(true_problem(world), cell, rounds, known) - _EXACT)


def flown(scenario: Scenario, seed: int, args: FleetBound) -> dict[str, int]:
    """The packets that each policy loses in one world, and the bound."""
    lost: dict[str, int] = {}
    policies: dict[str, Policy] = {"longest_queue_fast": AtFullSpeed("longest_queue"), "mpc": RecedingHorizonPolicy()}
    for name, policy in policies.items():
        world = Site(scenario).world()
        world.reset(seed=seed)
        lost[name] = sum(int(step.lost_packets) for step in rollout(world, policy, seed))
    return {"bound": least(Site(scenario), seed, args.cell, args.rounds, lost["mpc"]), **lost}


def main(args: FleetBound) -> int:
    """Prove, fly, print, write."""
    console = Console(highlight=False)
    scenario = long_pipeline() if args.scenario == "long_pipeline" else scenario_named(args.scenario)
    seeds = range(args.first, args.first + args.worlds)
    found = []
    for seed in seeds:
        found.append(flown(scenario, seed, args))
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
