"""The clairvoyant bound: the least that any fleet could have lost in one world, all arrivals known."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray, rate_bps
from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.records.summary import LossBound
from simulator.sites.site import Site

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.planning.fleet_problem import FleetProblem
    from simulator.bound.solver import Plan
    from simulator.world.environment import PipelineWorld

# UAVs x sensors x steps. With 30,000, as in scenario `dense`, building the model already takes half a minute.
MOST_CHOICES = 6_000


def true_problem(world: PipelineWorld) -> FleetProblem:
    """All steps that are left; where the world differs from the model, with the packets of the true links."""
    scenario, links = world.scenario, None
    if world.truth.differs:
        sums = np.arange((scenario.steps - len(world.tally)) * scenario.max_velocity + 1)
        links = true_links(world, scenario.steps, (world.fleet.progress_m + sums[:, None] * scenario.step_s)[:, None])
    return problem_with(world, scenario.steps, scenario, links)


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


def clairvoyant(site: Site, seed: int, time_limit_s: float = 60.0, workers: int = 8) -> Plan:
    """Bound one world with all its arrivals, links, wind and faults known.

    The bound omits batteries where a link's strength decides the energy of a packet, which can only lower it. The
    flight found is flown with the true batteries.

    Args:
        site: the scenario, and its trace if it has one.
        seed: of the world.
        time_limit_s: of the search; the bound and the flight are valid whenever it ends, but depend on the machine.
        workers: threads of the solver, for worlds that one thread does not solve quickly.

    Raises:
        RuntimeError: the world lost another number of packets than the plan, so one of the two is wrong.
        UsageError: the world has wind.
        ModuleNotFoundError: OR-Tools is not installed (extra ``bound``).
        Interrupted: by Ctrl-C, with the best plan so far.
    """
    from simulator.bound.solver import least_loss

    return confirmed(site, seed, least_loss(problem_of(site, seed), time_limit_s, workers))


def confirmed(site: Site, seed: int, plan: Plan) -> Plan:
    """The bound that a plan of the whole mission proves, and the losses of the plan's flight in the world.

    Where the world differs from the model, the flight may lose more than the plan, which omits what a weak link costs a
    battery.

    Raises:
        RuntimeError: the world lost another number of packets than the plan, or fewer than the bound.
    """
    flown, world = replay(site, seed, plan.actions), _reset(site, seed)
    if flown < plan.lower_bound or (flown != plan.lost_packets and not world.truth.differs):
        raise RuntimeError(
            f"the plan of seed {seed} loses {plan.lost_packets} packets, at least {plan.lower_bound}; "
            f"flown in the world {flown}"
        )
    return replace(plan, lost_packets=flown)


def problem_of(site: Site, seed: int) -> FleetProblem:
    """The whole mission as a planning problem, with the world's hidden state; raises ``UsageError`` in wind."""
    world = _reset(site, seed)
    if world.truth.wind.blows:
        raise UsageError(f"scenario {site.scenario.name} has wind, in which no plan is flown as made: it has no bound")
    return true_problem(world)


def replay(site: Site, seed: int, actions: NDArray[np.int64]) -> int:
    """Fly actions ``(T, I, 2)`` in the world; returns the packets lost."""
    world = _reset(site, seed)
    for step in actions:
        world.step({agent: step[uav] for agent, uav in world.live.items()})
    return sum(tally.lost_packets for tally in world.tally)


def _reset(site: Site, seed: int) -> PipelineWorld:
    world = site.world()
    world.reset(seed=seed)
    return world


def mission_bound(site: Site, seed: int, steps_flown: int, time_limit_s: float) -> LossBound | str:
    """The fewest packets that a fleet could have lost in this world, or the reason why that is unknown.

    Args:
        site: the scenario, and its trace if it has one.
        seed: of the world.
        steps_flown: of the mission; the bound is that of whole missions.
        time_limit_s: of the search. Ctrl-C ends it too, with the best so far.
    """
    scenario = site.scenario
    if steps_flown < scenario.steps:
        return "the mission ended before its last step"
    if scenario.uavs * scenario.sensors * scenario.steps > MOST_CHOICES:
        return "this world is too large for a short search; try `aicvds bound`"
    if scenario.wind_mps or scenario.gust_mps:
        return "in wind no plan is flown as made"
    try:
        from simulator.bound.solver import Interrupted

        try:
            bound = clairvoyant(site, seed, time_limit_s)
        except Interrupted as stopped:
            bound = confirmed(site, seed, stopped.plan)
    except ModuleNotFoundError:
        return "OR-Tools is not installed; pip install 'aic-vds[bound]'"
    except KeyboardInterrupt:
        return "the search was interrupted"
    return LossBound(lower_bound=bound.lower_bound, best_flight=bound.lost_packets, seconds=round(bound.seconds, 3))
