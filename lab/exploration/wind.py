"""Planning in a fully known world with wind: the places that it lets UAVs reach, and the clairvoyant bound there."""

from __future__ import annotations

import math
from dataclasses import replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from shared.planning.fleet_problem import FleetProblem
from shared.world.channel import FloatArray, IntArray
from simulator.bound.clairvoyant_bound import problem_with, replay, true_links
from simulator.bound.solver import Budget, Plan, least_loss, plan
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld

# The largest distance between two compared places of one stretch of way, metres.
_SPACING_M = 5.0
# For each candidate flight in wind: the steps of its plans (None: all remaining ones), and the deterministic seconds of
# each search. Neither is always better.
_CHASES = ((10, 0.3), (None, 3.0))


def bound_in_wind(site: Site, seed: int, time_limit_s: float = 60.0) -> Plan:
    """The fewest packets that any fleet could lose in a world with wind, and a flight made from step to step.

    The bound is that of a fleet that may fly in each step as far as the strongest wind could carry it, so it is lower
    than the true optimum.

    Raises:
        RuntimeError: the flight lost fewer packets than the bound.
    """
    best = least_loss(relaxed_problem(_reset(site, seed)), time_limit_s)
    candidates = [_chased(_reset(site, seed), steps, work) for steps, work in _CHASES]
    flown, actions = min(((replay(site, seed, actions), actions) for actions in candidates), key=itemgetter(0))
    if flown < best.lower_bound:
        raise RuntimeError(f"a flight of seed {seed} loses {flown} packets, the bound is {best.lower_bound}")
    return replace(best, actions=actions, lost_packets=flown)


def problem_in_wind(world: PipelineWorld, steps: int | None = None) -> FleetProblem:
    """The next steps in the mean wind; without gusts, which :func:`velocities_towards` compensates."""
    left = world.scenario.steps - len(world.tally)
    steps = min(steps or left, left)
    sums, end = steps * world.scenario.max_velocity + 1, len(world.tally) + steps
    return problem_with(world, end, world.scenario, true_links(world, end, course(world, sums)[:, None]))


def relaxed_problem(world: PipelineWorld) -> FleetProblem:
    """All steps that are left, as a problem whose bound holds in the world.

    In wind a UAV does not fly ``velocity x step_s``. The problem lets it fly any multiple of ``step_s`` metres up to
    the most that the wind allows in any step, and takes the best link within half of ``step_s`` around each. Every
    flight in the wind is such a flight, over links no better.
    """
    fastest = _fastest(world)
    sums = np.arange((world.scenario.steps - len(world.tally)) * fastest + 1)[:, None, None]
    around = np.linspace(-0.5, 0.5, math.ceil(world.scenario.step_s / _SPACING_M) + 1)[:, None]
    links = true_links(world, world.scenario.steps, world.fleet.progress_m + (sums + around) * world.scenario.step_s)
    return problem_with(world, world.scenario.steps, world.scenario.model_copy(update={"max_velocity": fastest}), links)


def course(world: PipelineWorld, sums: int) -> FloatArray:
    """The UAVs' progress after steps whose velocities sum to 0..sums - 1 in the mean wind, ``(sums, I)``, metres."""
    fleet, wind, step_s = world.fleet, world.truth.wind, world.scenario.step_s
    if not wind.blows:
        return fleet.progress_m + np.arange(sums)[:, None] * step_s
    reached = [fleet.progress_m]
    for _ in range(sums - 1):
        middle = reached[-1] + step_s / 2
        reached.append(reached[-1] + step_s * wind.stretch(wind.along_mps(middle, fleet.trajectories)))
    return np.array(reached)


def targets(world: PipelineWorld, velocity: IntArray) -> FloatArray:
    """The target progress ``(I,)`` of a plan's velocities ``(I,)`` in the next step, metres."""
    return np.asarray(course(world, world.scenario.max_velocity + 1)[velocity, np.arange(len(velocity))])


def velocities_towards(world: PipelineWorld, progress_m: FloatArray) -> IntArray:
    """The velocities ``(I,)`` that bring each UAV nearest to a progress ``(I,)`` in the next step, in any wind."""
    paths = world.fleet.trajectories
    levels = np.arange(world.scenario.max_velocity + 1)[:, None]
    now = np.broadcast_to(world.fleet.progress_m, (len(levels), len(paths)))
    reached = now + world.truth.wind.flown_m(levels, now, paths, len(world.tally))
    return np.asarray(np.abs(reached - progress_m).argmin(axis=0))


def _fastest(world: PipelineWorld) -> int:
    """The most multiples of ``step_s`` metres that a UAV covers in one of the steps left."""
    scenario, wind, uavs = world.scenario, world.truth.wind, world.scenario.uavs
    strongest = max(float(wind.gust_mps(step, uavs).max()) for step in range(len(world.tally), scenario.steps))
    stretch = 1.0 + (scenario.wind_mps + strongest) / scenario.max_velocity
    return math.ceil(scenario.max_velocity * min(max(stretch, 0.0), 2.0) - 1e-9)


def _reset(site: Site, seed: int) -> PipelineWorld:
    world = site.world()
    world.reset(seed=seed)
    return world


def _chased(world: PipelineWorld, steps: int | None, work: float) -> NDArray[np.int64]:
    """Fly a fully known world in wind, each step by a plan of the next ones, and return the actions."""
    actions = []
    while world.agents:
        problem = problem_in_wind(world, steps)
        chosen = plan(problem, Budget(work=work), "cautious").actions[0].copy()
        chosen[:, 1] = velocities_towards(world, targets(world, chosen[:, 1]))
        actions.append(chosen)
        world.step({agent: chosen[uav] for agent, uav in world.live.items()})
    return np.array(actions)
