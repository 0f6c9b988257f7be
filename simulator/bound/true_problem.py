"""The rest of a mission as a planning problem that knows the whole world: arrivals, links, wind and faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray, rate_bps
from shared.world.scenario import Scenario

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.planning.fleet_problem import FleetProblem
    from simulator.world.environment import PipelineWorld


def true_problem(world: PipelineWorld, steps: int | None = None, progress_m: FloatArray | None = None) -> FleetProblem:
    """The next steps, by default all that are left, from the world's present state.

    Where the world differs from the model, ``links`` has the packets of the true links; a UAV that has departed has
    none.

    Args:
        progress_m: the UAVs' progress after velocities that sum to 0, 1 and so on, ``(C, I)``; by default in still air.
    """
    end = world.scenario.steps if steps is None else min(len(world.tally) + steps, world.scenario.steps)
    links = None
    if world.truth.differs:
        if progress_m is None:
            sums = np.arange((end - len(world.tally)) * world.scenario.max_velocity + 1)
            progress_m = world.fleet.progress_m + sums[:, None] * world.scenario.step_s
        links = true_links(world, end, progress_m[:, None])
    return problem_with(world, end, world.scenario, links)


def problem_with(world: PipelineWorld, end: int, scenario: Scenario, links: list[IntArray] | None) -> FleetProblem:
    """The steps until ``end`` with these links, by ``scenario``, which may have another velocity than the world's."""
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
