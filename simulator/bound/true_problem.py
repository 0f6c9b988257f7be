"""The rest of a mission as a planning problem that knows the whole world: arrivals, links, wind and faults."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray, rate_bps
from shared.world.scenario import Scenario

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.planning.fleet_problem import FleetProblem
    from simulator.world.environment import PipelineWorld

# The largest distance between two compared places of one stretch of way, metres.
_SPACING_M = 5.0


def true_problem(world: PipelineWorld, steps: int | None = None) -> FleetProblem:
    """The next steps, by default all that are left, from the world's present state.

    Where the world differs from the model, ``links`` has the packets of the true links; a UAV that has departed has
    none. In wind the links are those at the places that the mean wind lets a UAV reach; gusts are left out, and
    :func:`velocities_towards` makes up for the next step's.
    """
    end = world.scenario.steps if steps is None else min(len(world.tally) + steps, world.scenario.steps)
    links = None
    if world.truth.differs:
        links = true_links(
            world, end, course(world, (end - len(world.tally)) * world.scenario.max_velocity + 1)[:, None]
        )
    return _problem(world, end, world.scenario, links)


def relaxed_problem(world: PipelineWorld) -> FleetProblem:
    """All steps that are left, as a problem whose bound holds in the world; :func:`true_problem` in still air.

    In wind a UAV does not fly ``velocity x step_s``. The problem lets it fly any multiple of ``step_s`` metres up to
    the most that the wind allows in any step, and takes the best link within half of ``step_s`` around each. Every
    flight in the wind is such a flight, over links no better.
    """
    if not world.truth.wind.blows:
        return true_problem(world)
    fastest = _fastest(world)
    sums = np.arange((world.scenario.steps - len(world.tally)) * fastest + 1)[:, None, None]
    around = np.linspace(-0.5, 0.5, math.ceil(world.scenario.step_s / _SPACING_M) + 1)[:, None]
    links = true_links(world, world.scenario.steps, world.fleet.progress_m + (sums + around) * world.scenario.step_s)
    return _problem(world, world.scenario.steps, world.scenario.model_copy(update={"max_velocity": fastest}), links)


def course(world: PipelineWorld, sums: int) -> FloatArray:
    """The UAVs' progress after steps whose velocities sum to 0..sums - 1 in the mean wind, ``(sums, I)``, metres."""
    fleet, wind, step_s = world.fleet, world.truth.wind, world.scenario.step_s
    if not wind.blows:
        return fleet.progress_m + np.arange(sums)[:, None] * step_s
    reached = [fleet.progress_m]
    for _ in range(sums - 1):
        middle = reached[-1] + step_s / 2
        reached.append(reached[-1] + step_s * wind.stretch(middle, fleet.trajectories))
    return np.array(reached)


def targets(world: PipelineWorld, velocity: IntArray) -> FloatArray:
    """The progress that a plan's velocities ``(I,)`` in the next step aim at, ``(I,)``, metres."""
    return np.asarray(course(world, world.scenario.max_velocity + 1)[velocity, np.arange(len(velocity))])


def velocities_towards(world: PipelineWorld, progress_m: FloatArray) -> IntArray:
    """The velocities ``(I,)`` that bring each UAV nearest to a progress ``(I,)`` in the next step, in any wind."""
    paths = world.fleet.trajectories
    levels = np.arange(world.scenario.max_velocity + 1)[:, None]
    now = np.broadcast_to(world.fleet.progress_m, (len(levels), len(paths)))
    reached = now + world.truth.wind.flown_m(levels, now, paths, len(world.tally))
    return np.asarray(np.abs(reached - progress_m).argmin(axis=0))


def _problem(world: PipelineWorld, end: int, scenario: Scenario, links: list[IntArray] | None) -> FleetProblem:
    from shared.planning.fleet_problem import FleetProblem

    sensors, fleet = world.sensors, world.fleet
    # A problem takes the price of a packet from the mean loss right above a sensor, and a true link may be cheaper.
    battery = sensors.battery if links is None or not _cheaper(scenario) else np.full_like(sensors.battery, 1e9)
    return FleetProblem(
        scenario=scenario,
        trajectories=fleet.trajectories,
        progress_m=fleet.progress_m,
        places=sensors.positions,
        queue=sensors.queue,
        battery=battery,
        arrivals=sensors.arrivals[len(world.tally) : end],
        links=links,
    )


def _fastest(world: PipelineWorld) -> int:
    """The most multiples of ``step_s`` metres that a UAV covers in one of the steps left."""
    scenario, wind, uavs = world.scenario, world.truth.wind, world.scenario.uavs
    strongest = max(float(wind.gust_mps(step, uavs).max()) for step in range(len(world.tally), scenario.steps))
    stretch = 1.0 + (scenario.wind_mps + strongest) / scenario.max_velocity
    return math.ceil(scenario.max_velocity * min(max(stretch, 0.0), 2.0) - 1e-9)


def true_links(world: PipelineWorld, end: int, progress: FloatArray) -> list[IntArray]:
    """By UAV the packets of its links until a step, ``(1 or steps, C, J)``, at a progress ``(C, n, I)``, metres.

    Each is the best of the n links.
    """
    scenario, fleet, channel = world.scenario, world.fleet, world.truth.channel
    step, tables = len(world.tally), []
    position = fleet.at(progress)
    offset = position[..., None, :] - world.sensors.positions
    distance = np.hypot(offset[..., 0], offset[..., 1])
    near = distance <= scenario.radio_radius_m
    place = np.broadcast_to(channel.place_db(position, progress), distance.shape)[near]
    reach = distance[near]
    # Without fading and faults one table is that of all steps.
    for now in range(step, end if channel.changes or scenario.departures else step + 1):
        fade = np.broadcast_to(channel.fade_db(now + 1), distance.shape)[near]
        share = np.broadcast_to(channel.share(distance, now + 1), distance.shape)[near]
        packets = np.zeros(distance.shape, dtype=np.int64)
        packets[near] = channel.at(reach, place + fade, share).packets
        tables.append(packets.max(axis=1) * world.truth.faults.present(now)[:, None])
    whole: NDArray[np.int64] = np.stack(tables)
    return [np.ascontiguousarray(whole[:, :, uav]) for uav in range(scenario.uavs)]


def _cheaper(scenario: Scenario) -> bool:
    """Whether the rate right above a sensor may be more than that of the mean loss."""
    most = scenario.link_share * scenario.bandwidth_hz * scenario.spectral_cap
    return float(rate_bps(0.0, scenario)) < most
