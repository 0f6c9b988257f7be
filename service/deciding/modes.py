"""The modes of decision: each one's prompt and choice. A mission's mode is one of these objects."""

import asyncio
import logging
from concurrent.futures import Executor
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from service.deciding.attended_state import AttendedState
from service.deciding.decision_task import Choice, DecisionTask, Fallback
from service.deciding.deliberation import Deliberation, candidates_of, template_of
from service.deciding.llm_query import LlmQueries
from service.deciding.rollout_evaluator import Evaluation
from service.llm.answers import Completion, NoDecision
from service.prompting.candidates import CandidateSet
from service.prompting.prompt import Prompt
from shared.wire.schemas import Mode
from shared.world.step_rule import Action

log = logging.getLogger(__name__)


def verify(state: AttendedState, answer: Action) -> None:
    """Raises :class:`NoDecision` if the answer breaks a rule; mode ``guided`` weighs each answer instead.

    No packets can be collected from a sensor out of the UAV's reach after the step, or with a flat battery, and a
    transmission from a sensor that another UAV has reserved fails. A sensor out of reach is allowed while no admissible
    sensor is in reach at any velocity.
    """
    mission, (sensor, velocity) = state.mission, answer
    if sensor in mission.reservations.of_others(state.step, state.uav_id):
        raise NoDecision("answer_reserved", f"another UAV has sensor {sensor} meanwhile")
    if mission.spec.verify == "off":
        return
    if mission.belief.battery[sensor] <= 0:
        raise NoDecision("rule_battery", f"the battery of sensor {sensor} is flat")
    likely = state.reach.likely
    row = int(np.flatnonzero(state.state.ids == sensor)[0])
    if not likely[velocity, row] and likely[:, state.state.admissible].any():
        raise NoDecision("rule_reach", f"sensor {sensor} is out of reach after a step at {velocity} m/s")


@dataclass(frozen=True, slots=True)
class Question:
    """A prompt, which an LLM may or may not receive.

    Attributes:
        deliberation: of mode ``guided``.
        candidates: of mode ``llm`` with the compact prompt.
    """

    prompt: Prompt
    deliberation: Deliberation | None = None
    candidates: CandidateSet | None = None


class PolicyMode:
    """No LLM and no learned values: the plan decides, or look-ahead if there is no plan.

    The other modes ask and choose in other ways.

    Attributes:
        plan_share: the share of the time left that the planner may take; None if the mode needs no plan.
        plan_first: whether the plan is one of the mode's advisers, so that the state is taken after it.
    """

    plan_share: ClassVar[float | None] = 1.0
    plan_first: ClassVar[bool] = False

    def question(self, state: AttendedState, task: DecisionTask) -> Question:
        """The template's prompt, by which tokens are accounted for in every mode."""
        mission = state.mission
        return Question(mission.template.prompt(state.state, state.shown(), mission.experiences.block))

    async def choose(self, state: AttendedState, question: Question, task: DecisionTask) -> Choice | Fallback:
        """Always the LLM-free policy."""
        return Fallback("mode_policy")


class ValueMode(PolicyMode):
    """The learned values decide."""

    plan_share: ClassVar[float | None] = None

    async def choose(self, state: AttendedState, question: Question, task: DecisionTask) -> Choice | Fallback:
        """The best-scored sensor at its best velocity."""
        if not state.rows:
            return Fallback("no_candidate")
        return Choice(state.best_by_value(), "mode_value")


class LlmMode(PolicyMode):
    """The paper's mode: the LLM's answer is the decision, once it has passed every check."""

    def __init__(self, queries: LlmQueries) -> None:
        self._queries = queries

    async def choose(self, state: AttendedState, question: Question, task: DecisionTask) -> Choice | Fallback:
        """The LLM's sensor and velocity."""
        if not state.rows:
            return Fallback("no_candidate")
        if not state.mission.prompt_fits:
            return Fallback("llm_unavailable")
        completion: Completion | None = None
        levels = state.mission.scenario.max_velocity + 1
        try:
            try:
                completion = await self._queries.ask_for_pair(
                    state.mission, question.prompt, state.kept_ids, levels, task.deadline
                )
            finally:
                task.watch.ended.append(("llm", perf_counter()))
            answer = self._queries.read_pair(state.mission, completion, state.kept_ids, levels)
            if not state.mission.guidance.confirmed.allows(answer.velocity):
                raise NoDecision("answer_velocity", f"the operator forbids {answer.velocity} m/s")
            verify(state, answer)
        except NoDecision as error:
            log.debug("mission %s: %s: %s", state.mission.mission_id, error.reason, error)
            return Fallback(error.reason, completion, completion.model if completion else None)
        return Choice(answer, None, completion, completion.model)


class LetterMode(LlmMode):
    """Mode ``llm`` with the compact prompt: the likeliest letter is the decision, once it has passed every check."""

    def question(self, state: AttendedState, task: DecisionTask) -> Question:
        """The candidates' prompt."""
        if not state.rows:
            return super().question(state, task)
        template = template_of(state.mission)
        candidates = candidates_of(state, template)
        prompt = template.choice_prompt(candidates, state.state, state.mission.experiences.block)
        return Question(prompt, candidates=candidates)

    async def choose(self, state: AttendedState, question: Question, task: DecisionTask) -> Choice | Fallback:
        """The likeliest candidate."""
        if question.candidates is None:
            return Fallback("no_candidate")
        advice = await self._queries.ask(state.mission, question.candidates, question.prompt, task.deadline)
        task.watch.ended.append(("llm", perf_counter()))
        probabilities = advice.over(question.candidates.actions)
        if probabilities is None:
            return Fallback(advice.reason or "answer_format", advice.completion, advice.model)
        state.show_probabilities([action.sensor_id for action in question.candidates.actions], probabilities)
        answer = question.candidates.actions[int(probabilities.argmax())]
        try:
            verify(state, answer)
        except NoDecision as error:
            return Fallback(error.reason, advice.completion, advice.model)
        return Choice(answer, None, advice.completion, advice.model)


class GuidedMode(PolicyMode):
    """The LLM's preference is weighed with the other advisers' and with the rollout evaluator's losses."""

    plan_share: ClassVar[float | None] = 0.5
    plan_first: ClassVar[bool] = True

    def __init__(self, queries: LlmQueries, evaluating: Executor) -> None:
        self._queries = queries
        self._evaluating = evaluating

    def question(self, state: AttendedState, task: DecisionTask) -> Question:
        """The candidates' prompt, or this UAV's share of the batch's where the LLM was asked already."""
        if not state.rows:
            return super().question(state, task)
        deliberation = Deliberation.of(state)
        return Question(task.advice.prompt if task.advice else deliberation.prompt, deliberation)

    async def choose(self, state: AttendedState, question: Question, task: DecisionTask) -> Choice | Fallback:
        """The best candidate by advice and expected loss; the evaluator works while the LLM is asked.

        Without the LLM's advice the others decide: source ``policy``, with the reason. Without the evaluation the
        LLM-free policy decides.
        """
        deliberation, advice, mission = question.deliberation, task.advice, state.mission
        if deliberation is None:
            return Fallback("no_candidate")
        result = asyncio.get_running_loop().run_in_executor(self._evaluating, deliberation.evaluate)
        waiting: set[asyncio.Future[Any]] = {result}
        if advice is None:
            asking = asyncio.create_task(
                self._queries.ask(mission, deliberation.candidates, deliberation.prompt, task.deadline)
            )
            asking.add_done_callback(lambda _: task.watch.ended.append(("llm", perf_counter())))
            waiting.add(asking)
        try:
            await asyncio.wait(waiting, timeout=task.evaluation_deadline.left())
            # The query ends with its own deadline, which is no later than the evaluation's.
            advice = advice or await asking
            evaluation = _evaluation_of(result)
        finally:
            # Drops an evaluation that waits for a thread.
            for unfinished in waiting:
                unfinished.cancel()
        task.watch.ended.append(("judge", perf_counter()))
        if evaluation is None:
            reason = advice.reason or "critic_timeout"
            return Fallback(reason, advice.completion, advice.model, unevaluated=True)
        reserved = mission.reservations.of_others(state.step, state.uav_id)
        llm = advice.over(deliberation.candidates.actions)
        trust = mission.trust[advice.model or ""]
        conclusion = deliberation.conclude(trust, evaluation, llm, calibrated=advice.calibrated, reserved=reserved)
        if conclusion is None:
            return Fallback("answer_reserved", advice.completion, advice.model)
        # Other UAVs may have reserved every sensor that the LLM named.
        missing = advice.reason or ("answer_reserved" if llm is None else None)
        return Choice(conclusion.action, missing, advice.completion, advice.model, conclusion.report, conclusion.advice)


def _evaluation_of(result: asyncio.Future[Evaluation]) -> Evaluation | None:
    """The evaluation; None if it is late or failed."""
    if not result.done() or result.cancelled():
        return None
    try:
        return result.result()
    except Exception:
        log.exception("the rollout evaluator failed; decisions go on without it")
        return None


def modes_by_name(queries: LlmQueries, evaluating: Executor) -> dict[tuple[Mode, bool], PolicyMode]:
    """Every mode, by its name and by whether the mission has the compact prompt."""
    guided, value, policy = GuidedMode(queries, evaluating), ValueMode(), PolicyMode()
    modes: dict[tuple[Mode, bool], PolicyMode] = {("llm", False): LlmMode(queries), ("llm", True): LetterMode(queries)}
    for compact in (False, True):
        modes |= {("guided", compact): guided, ("value", compact): value, ("policy", compact): policy}
    return modes
