"""The planner with the true links: a reference that bounds the benefit of learning the channel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.exploration.wind import course
from shared.planning.receding import Draft
from shared.world.channel import IntArray
from simulator.bound.clairvoyant_bound import true_links
from simulator.flying.pilots import LocalPilot, PilotChoice
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation


def true_links_of_plan(world: PipelineWorld, draft: Draft) -> list[IntArray]:
    """By UAV of a plan the packets of its true links, ``(1 or H, C, n + 1)``, as a plan's problem has them."""
    horizon = draft.problem.horizon
    ahead = course(world, horizon * world.scenario.max_velocity + 1)[:, None]
    # Past the scenario's last step the world has no links, and no decisions either.
    links = true_links(world, len(world.tally) + horizon, ahead)
    nowhere = ((0, 0), (0, 0), (0, 1))
    return [np.pad(links[index][:, :, draft.kept], nowhere) for index in draft.uavs]


class InformedPlanner(RecedingHorizonPolicy):
    """The planner of ``mpc`` with the true links of every step of its horizon.

    The links include shadowing, fading, dead radios, the links' share and the mean wind. Queues, arrivals and later
    gusts are expected from the UAVs' reports, as in ``mpc``. No UAV could fly it: it reads the world's hidden state.

    Args:
        world: in the state that the decisions are for.
    """

    def __init__(self, world: PipelineWorld) -> None:
        self._world = world

    def draft(self, uav: int, taken: frozenset[int]) -> Draft | None:
        """The problem with the true links."""
        draft = super().draft(uav, taken)
        if draft is None or not self._world.truth.differs:
            return draft
        links = true_links_of_plan(self._world, draft)
        return replace(draft, problem=replace(draft.problem, links=links, chances=None))


class InformedPilot(LocalPilot):
    """The pilot of :class:`InformedPlanner`; it flies a twin of the world in parallel, to read the twin's state.

    Args:
        site: of the world.
        seed: of the world.
    """

    def __init__(self, site: Site, seed: int) -> None:
        self._twin = site.world()
        self._twin.reset(seed=seed)
        self._actions: dict[str, tuple[int, int]] = {}
        super().__init__("informed", site.scenario, seed, InformedPlanner(self._twin))

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The plan's choice."""
        if int(observation["step"][0]) > len(self._twin.tally):
            self._twin.step(self._actions)
            self._actions = {}
        choice = super().decide(uav, observation, taken)
        self._actions[f"uav_{uav}"] = choice.sensor, choice.velocity
        return choice
