"""The stages of a decision: augment, attend, prompt, choose, enforce, commit."""

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from time import perf_counter

from service.config.settings import Settings
from service.deciding.advisers import look_ahead
from service.deciding.attended_state import AttendedState
from service.deciding.decision_task import Choice, DecisionTask, Fallback
from service.deciding.llm_query import LlmQueries
from service.deciding.modes import modes_by_name
from service.deciding.stopwatch import Deadline
from service.mission.decisions import new_decision_id
from service.mission.events import AdviserReport
from service.mission.mission import Mission
from service.prompting.prompt import Prompt
from service.prompting.token_accounting import TokenCounter
from shared.kit.cores import usable_cores
from shared.wire.schemas import Tokens
from shared.world.step_rule import Action

# The initial estimate of a decision's own seconds, and the length of its average.
_OWN_S, _OWN_MEMORY = 0.03, 20


@dataclass(frozen=True, slots=True)
class RecordedDecision:
    """A decision that its mission has recorded.

    Attributes:
        tokens: of the prompt, before the server's own count is known.
        latency_ms: by stage, and in total.
    """

    decision_id: str
    task: DecisionTask
    state: AttendedState
    prompt: Prompt
    tokens: Tokens
    choice: Choice
    latency_ms: dict[str, float]


class Pipeline:
    """Decides for one UAV at a time, in the mode of its mission, and begins the fleets' plans.

    Attributes:
        own_s: the average of the seconds that a decision takes besides the LLM and the plan.
    """

    def __init__(self, settings: Settings, queries: LlmQueries, counter: TokenCounter) -> None:
        self.own_s = _OWN_S
        self._counter = counter
        self._planner_s = settings.planner_ms / 1e3
        self._planning = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="planner")
        self._evaluating = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="evaluator")
        self._plans: set[asyncio.Task[None]] = set()
        self._modes = modes_by_name(queries, self._evaluating)

    async def decide_one(self, task: DecisionTask) -> RecordedDecision:
        """Decide for one UAV, and record the decision in its mission; raises as :meth:`Mission.commit`."""
        mode = self._modes[task.mission.mode, task.mission.spec.prompt.format == "compact"]
        if mode.plan_first:
            await _await_plan(task)
        state = AttendedState.of(task.mission, task.uav, task.step, task.watch)
        question = mode.question(state, task)
        tokens = self._counter.account(question.prompt)
        task.watch.ended.append(("prompt", perf_counter()))
        choice = await mode.choose(state, question, task)
        if isinstance(choice, Fallback):
            if not mode.plan_first:
                await _await_plan(task)
            choice = choice.to(_without_llm(state))
        orders, decision_id = task.mission.guidance.orders, new_decision_id()
        if orders is not None:
            # The operator may have confirmed orders since the mode's choice.
            velocity = orders.nearest(choice.action.velocity, task.mission.scenario.max_velocity + 1)
            choice = replace(choice, action=Action(choice.action.sensor_id, velocity))
        fastest = task.mission.belief.drift.fastest([task.uav.uav_id], choice.action.velocity)
        allows = task.mission.guidance.confirmed.allows
        if fastest < choice.action.velocity and (slower := [v for v in range(fastest + 1) if allows(v)]):
            choice = replace(choice, action=Action(choice.action.sensor_id, slower[-1]))
        pending = state.pending(decision_id, choice.action)
        task.watch.ended.append(("check", perf_counter()))
        report = None if choice.advice is None else AdviserReport(choice.model or "", choice.advice)
        task.mission.commit(pending, task.attempt, report)
        task.mission.reports.remember(task.uav, task.step, decision_id)
        times = task.watch.milliseconds(perf_counter())
        waited_ms = times.get("llm", 0.0) + times.get("plan", 0.0)
        self.own_s += ((times["total"] - waited_ms) / 1e3 - self.own_s) / _OWN_MEMORY
        return RecordedDecision(decision_id, task, state, question.prompt, tokens, choice, times)

    def begin_plan(
        self, mission: Mission, uavs: Sequence[int], step: int, deadline: Deadline
    ) -> asyncio.Task[None] | None:
        """Begin to plan for UAVs of this step, if their mission's mode may need a plan by this deadline."""
        share = self._modes[mission.mode, mission.spec.prompt.format == "compact"].plan_share
        if mission.planner is None or share is None:
            return None
        # In mode `guided` the LLM, which comes after the plan, has as much time as the planner.
        seconds = min(self._planner_s, deadline.left() * share)
        taken = mission.reservations.of_others(step, uavs[0])
        task = asyncio.create_task(mission.planner.plan(uavs, taken, seconds, self._planning))
        self._plans.add(task)
        task.add_done_callback(self._plans.discard)
        return task

    async def close(self) -> None:
        """Finish the plan and the evaluation that run, and drop the queued ones."""
        for threads in (self._planning, self._evaluating):
            await asyncio.to_thread(threads.shutdown, cancel_futures=True)


async def _await_plan(task: DecisionTask) -> None:
    """Wait for the plan until the deadline; a plan that is late serves the fleet's next decisions."""
    if task.plan is not None:
        await asyncio.wait({task.plan}, timeout=task.deadline.left())
    task.watch.ended.append(("plan", perf_counter()))


def _without_llm(state: AttendedState) -> Action:
    """The plan's action, or one step of look-ahead where there is no plan."""
    mission = state.mission
    reserved = mission.reservations.of_others(state.step, state.uav_id)
    planned = mission.planner.action(state.uav_id, reserved) if mission.planner is not None else None
    if planned is not None:
        return planned
    sensor, velocity = look_ahead(state.state, state.reach, reserved, state.guidance)
    if sensor in reserved:
        # Other UAVs have reserved every reported sensor. An unreported sensor is worth a try, a reserved one is not.
        sensor = next((i for i in range(mission.scenario.sensors) if i not in reserved), sensor)
    return Action(sensor, velocity)
