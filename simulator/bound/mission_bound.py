"""The bound on a flown mission's losses, searched for a limited time after the flight."""

from __future__ import annotations

from simulator.records.summary import LossBound
from simulator.sites.site import Site

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
    from simulator.bound.clairvoyant_bound import clairvoyant, confirmed
    from simulator.bound.solver import Interrupted

    try:
        try:
            bound = clairvoyant(site, seed, time_limit_s)
        except Interrupted as stopped:
            bound = confirmed(site, seed, stopped.plan)
    except ModuleNotFoundError:
        return "OR-Tools is not installed; pip install 'aic-vds[bound]'"
    return LossBound(lower_bound=bound.lower_bound, best_flight=bound.lost_packets, seconds=round(bound.seconds, 3))
