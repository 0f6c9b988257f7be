"""The planner: receding-horizon plans for a whole fleet, without an LLM, searched outside the event loop."""

import asyncio
import logging
from collections.abc import Collection
from concurrent.futures import Executor

from shared.belief.fleet_belief import FleetBelief
from shared.planning.fleet_problem import Found
from shared.planning.orders import Guidance
from shared.planning.receding import Draft, RecedingHorizon
from shared.world.scenario import Scenario

log = logging.getLogger(__name__)

# For a larger world a plan takes too long to set up. There the LLM-free policy, look-ahead, stands in for the plan.
MAX_SENSORS = 1000
MAX_UAVS = 20


def can_plan(scenario: Scenario) -> bool:
    """Whether the fleet is small enough to plan for."""
    return scenario.sensors <= MAX_SENSORS and scenario.uavs <= MAX_UAVS


class MissionPlanner(RecedingHorizon):
    """One mission's plan, renewed with the reports of the UAVs. Only the event loop uses it; another thread searches.

    Args:
        scenario: the mission's world.
        belief: the fleet's, which the mission updates with every report and every decision.
    """

    def __init__(self, scenario: Scenario, belief: FleetBelief) -> None:
        super().__init__(scenario, belief)
        self._lock = asyncio.Lock()

    def follow(self, guidance: Guidance) -> None:
        """Plan by this guidance from now on; the plans made before are dropped."""
        self.guidance = guidance
        self.plans.clear()

    async def plan(self, uavs: Collection[int], reserved: Collection[int], seconds: float, executor: Executor) -> None:
        """Plan for UAVs that have no decision in this step yet; the search runs in the executor.

        Args:
            uavs: UAVs that were located in this step.
            reserved: sensors that are reserved in this step.
            seconds: wall clock for the search; the best plan until then counts.
        """
        async with self._lock:
            horizon = self.copy()

            def search() -> tuple[Draft, Found] | None:
                draft = horizon.draft(uavs, reserved)
                return None if draft is None else (draft, draft.search(max(seconds, 0.01)))

            try:
                found = await asyncio.get_running_loop().run_in_executor(executor, search)
            except Exception:
                log.exception("the planner failed; decisions go on without it")
                return
            if found is not None:
                self.adopt(*found)
