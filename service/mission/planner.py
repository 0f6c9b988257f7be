"""The planner: what the edge decides by without an LLM, for the whole fleet at once and beside the event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection
from concurrent.futures import Executor
from importlib.util import find_spec

from shared.actions import Action
from shared.fleetplan import FleetBelief, RecedingHorizon
from shared.guidance import Guidance
from shared.scenario import Scenario

log = logging.getLogger(__name__)

# More make a plan's problem slow to build, and the learned values decide.
MOST_SENSORS = 1000
MOST_UAVS = 20


def can_plan(scenario: Scenario) -> bool:
    """Whether OR-Tools is installed (extra ``planner``) and the fleet is small enough to plan for."""
    small = scenario.sensors <= MOST_SENSORS and scenario.uavs <= MOST_UAVS
    return small and find_spec("ortools") is not None


class Planner:
    """One mission's plan, made again with what each UAV reports; only the event loop touches it.

    Args:
        scenario: the mission's world.
        belief: the fleet's, which the mission tells what it hears and what it answers.
    """

    def __init__(self, scenario: Scenario, belief: FleetBelief) -> None:
        self._belief = belief
        self._horizon = RecedingHorizon(scenario, belief)
        self._turn = asyncio.Lock()

    def begin(self, step: int) -> None:
        """A UAV is at this step; earlier ones are over for the plan."""
        self._horizon.begin(step)

    def obey(self, guidance: Guidance) -> None:
        """Plan by this from now on; what was planned before is not flown."""
        self._horizon.guidance = guidance
        self._horizon.plans.clear()

    async def plan(self, uavs: Collection[int], taken: Collection[int], seconds: float, beside: Executor) -> None:
        """Plan for UAVs that are yet to be told in this step, searching in another thread.

        Args:
            uavs: they were located in this step.
            taken: sensors given away in this step.
            seconds: wall clock for the search; the best plan until then counts.
            beside: runs the search.
        """
        async with self._turn:
            draft = self._horizon.draft(uavs, taken)
            if draft is None:
                return
            try:
                best = await asyncio.get_running_loop().run_in_executor(beside, draft.search, max(seconds, 0.01))
            except Exception:
                log.exception("the planner failed; decisions go on without it")
                return
            self._horizon.adopt(draft, best)

    def action(self, uav: int, taken: Collection[int] = ()) -> Action | None:
        """What the plan has a UAV do now: sensor and velocity.

        None without a plan of this step, where nothing is in reach, or where the sensor was given away meanwhile.
        """
        here = self._belief.uavs.get(uav)
        actions = self._horizon.plans.get(uav)
        if here is None or here.step != self._horizon.step or actions is None or not len(actions):
            return None
        sensor, velocity = actions[0].tolist()
        return None if sensor < 0 or sensor in taken else Action(int(sensor), int(velocity))

    def course(self) -> dict[int, list[Action]]:
        """The whole plan from this step on: by UAV, (sensor, velocity) a step; sensor -1 where nothing is in reach."""
        return {uav: [Action(int(s), int(v)) for s, v in plan.tolist()] for uav, plan in self._horizon.plans.items()}
