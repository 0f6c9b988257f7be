"""The clairvoyant bound: the least that any fleet could have lost in one world, all arrivals known."""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from simulator.bound.true_problem import relaxed_problem, targets, true_problem, velocities_towards
from simulator.records.summary import LossBound
from simulator.sites.site import Site

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.planning.fleet_problem import FleetProblem
    from simulator.bound.solver import Plan
    from simulator.world.environment import PipelineWorld

# For each flight tried in wind: the steps of its plans (None: all remaining ones), and the deterministic seconds of
# each search. Neither is always better.
_CHASES = ((10, 0.3), (None, 3.0))


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
        ModuleNotFoundError: OR-Tools is not installed (extra ``bound``).
        Interrupted: by Ctrl-C, with the best plan so far.
    """
    from simulator.bound.solver import least_loss

    return confirmed(site, seed, least_loss(problem_of(site, seed), time_limit_s, workers))


def confirmed(site: Site, seed: int, plan: Plan) -> Plan:
    """The bound that a plan of the whole mission proves, and the losses of the plan's flight in the world.

    Where the world differs from the model, the flight may lose more than the plan, which omits what a weak link costs a
    battery. In wind the plan cannot be flown, and another one is made from step to step.

    Raises:
        RuntimeError: the world lost another number of packets than the plan, or fewer than the bound.
    """
    world = _reset(site, seed)
    tried = [plan.actions]
    if world.truth.wind.blows:
        tried = [_chased(_reset(site, seed), steps, work) for steps, work in _CHASES]
    flown, actions = min(((replay(site, seed, actions), actions) for actions in tried), key=itemgetter(0))
    if flown < plan.lower_bound or (flown != plan.lost_packets and not world.truth.differs):
        raise RuntimeError(
            f"the plan of seed {seed} loses {plan.lost_packets} packets, at least {plan.lower_bound}; "
            f"flown in the world {flown}"
        )
    return replace(plan, actions=actions, lost_packets=flown)


def problem_of(site: Site, seed: int) -> FleetProblem:
    """The whole mission as a planning problem, with the world's hidden state."""
    return relaxed_problem(_reset(site, seed))


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


def _chased(world: PipelineWorld, steps: int | None, work: float) -> NDArray[np.int64]:
    """Fly a fully known world in wind, each step by a plan of the next ones, and return the actions."""
    from simulator.bound.solver import Budget, plan

    actions = []
    while world.agents:
        problem = true_problem(world, steps)
        chosen = plan(problem, Budget(work=work), "cautious").actions[0].copy()
        chosen[:, 1] = velocities_towards(world, targets(world, chosen[:, 1]))
        actions.append(chosen)
        world.step({agent: chosen[uav] for agent, uav in world.live.items()})
    return np.array(actions)


# UAVs x sensors x steps. With 30,000, as in scenario `dense`, building the model already takes half a minute.
MOST_CHOICES = 6_000


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
    from simulator.bound.solver import Interrupted

    try:
        try:
            bound = clairvoyant(site, seed, time_limit_s)
        except Interrupted as stopped:
            bound = confirmed(site, seed, stopped.plan)
    except ModuleNotFoundError:
        return "OR-Tools is not installed; pip install 'aic-vds[bound]'"
    return LossBound(lower_bound=bound.lower_bound, best_flight=bound.lost_packets, seconds=round(bound.seconds, 3))
