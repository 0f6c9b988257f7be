"""A fleet's decisions at one step: one plan, one query to the LLM where it can serve all, and a share of time each."""

import asyncio
from time import perf_counter

from service.deciding.attended_state import AttendedState
from service.deciding.decision_task import RESERVE_S, DecisionTask
from service.deciding.deliberation import LlmAdvice
from service.deciding.llm_query import LlmQueries
from service.deciding.pipeline import Pipeline, RecordedDecision
from service.deciding.stopwatch import Deadline, Stopwatch
from service.mission.mission import Mission
from shared.wire.schemas import BatchRequest

# A query about all UAVs gets at most the first share of the batch's time, and is not sent with less than the second.
# The rest is for the UAVs' own decisions one after another, with a safety factor of two.
_MAX_QUERY_SHARE, _MIN_QUERY_SHARE = 0.75, 0.25


class BatchDecider:
    """Decides for the UAVs of a batch in their order."""

    def __init__(self, pipeline: Pipeline, queries: LlmQueries) -> None:
        self._pipeline = pipeline
        self._queries = queries

    async def decide(
        self, mission: Mission, request: BatchRequest, watch: Stopwatch, deadline: Deadline
    ) -> list[RecordedDecision]:
        """The decisions for the UAVs of a request; its outcomes are already applied.

        One plan serves all UAVs until one of them departs from it; then the remaining UAVs get a new plan. Each UAV has
        an equal share of the remaining time.
        """
        step, uavs = request.step, [uav.uav_id for uav in request.uavs]
        # Every report is observed before the first decision. Attempts are numbered before the query to the LLM, so that
        # a repeated batch that arrives meanwhile is the later attempt.
        attempts = {uav.uav_id: mission.observe(uav, step) for uav in request.uavs}
        plan: asyncio.Task[None] | None = None
        advice: dict[int, LlmAdvice] = {}
        query_s = self._query_s(deadline.at - watch.started, len(uavs))
        if query_s is not None and self._queries.may_ask_for_fleet(mission, len(uavs)):
            plan = self._pipeline.begin_plan(mission, uavs, step, Deadline(deadline.at - RESERVE_S))
            states = [AttendedState.of(mission, uav, step, watch) for uav in request.uavs]
            advice = await self._queries.ask_for_fleet(mission, states, Deadline(watch.started + query_s))
            watch.ended.append(("llm", perf_counter()))
        decisions: list[RecordedDecision] = []
        for index, uav in enumerate(request.uavs):
            own = Stopwatch() if index else watch
            now, later = perf_counter(), len(uavs) - index - 1
            share_s = (deadline.at - now) / (later + 1)
            plan = plan or self._pipeline.begin_plan(mission, uavs[index:], step, Deadline(now + share_s - RESERVE_S))
            mine = Deadline(now + share_s - RESERVE_S)
            # The evaluator may exceed its UAV's share, as long as enough time is left for the later UAVs.
            evaluation = max(mine, Deadline(deadline.at - RESERVE_S - self._pipeline.own_s * later))
            deadline_ms = max(1, int((evaluation.at + RESERVE_S - own.started) * 1e3))
            attempt, advised = attempts[uav.uav_id], advice.get(uav.uav_id)
            task = DecisionTask(mission, uav, step, attempt, deadline_ms, mine, evaluation, own, plan, advised)
            decided = await self._pipeline.decide_one(task)
            if mission.planner is None or mission.planner.action(uav.uav_id) != decided.choice.action:
                plan = None
            decisions.append(decided)
            # Requests of other fleets continue between two UAVs.
            await asyncio.sleep(0)
        return decisions

    def _query_s(self, total_s: float, uavs: int) -> float | None:
        """Seconds for a query about all UAVs at once; None if the batch has too little time."""
        seconds = min(_MAX_QUERY_SHARE * total_s, total_s - 2 * uavs * self._pipeline.own_s)
        return seconds if seconds >= _MIN_QUERY_SHARE * total_s else None
