"""The planner: receding-horizon plans for a whole fleet, without an LLM, searched outside the event loop."""

import asyncio
import logging
from collections.abc import Collection
from concurrent.futures import Executor

from shared.belief.fleet_belief import FleetBelief
from shared.planning.fleet_problem import Found
from shared.planning.orders import Guidance
from shared.planning.receding import JOINT_UAVS, Draft, RecedingHorizon
from shared.world.scenario import Scenario

log = logging.getLogger(__name__)

# Of more, plans take too long. There the LLM-free policy, look-ahead, stands in for the plan.
MAX_SENSORS, MAX_UAVS, MAX_CAPACITY = 1000, 40, 2000


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
        step = self.step
        async with self._lock:
            if self.step != step or self._belief.decided(step).keys() >= {*uavs}:
                return  # While this plan waited for others, its decisions were answered without it.
            horizon = self.copy()

            def search() -> list[tuple[Draft, Found]]:
                # Of many UAVs at once, each plan chooses the actions of as many as a plan covers.
                found = []
                groups = [list(uavs)[first : first + JOINT_UAVS] for first in range(0, len(uavs), JOINT_UAVS)]
                for group in groups:
                    if (draft := horizon.draft(group, reserved)) is not None:
                        found.append((draft, draft.search(max(seconds / len(groups), 0.01))))
                        horizon.adopt(*found[-1])
                return found

            try:
                found = await asyncio.get_running_loop().run_in_executor(executor, search)
            except Exception:
                log.exception("the planner failed; decisions go on without it")
                return
            # The orders may have changed meanwhile.
            for draft, best in found if horizon.guidance is self.guidance else ():
                self.adopt(draft, best)
