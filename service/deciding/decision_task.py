"""The task of one UAV's decision, and its choice."""

import asyncio
from dataclasses import dataclass

from service.deciding.deliberation import LlmAdvice
from service.deciding.stopwatch import Deadline, Stopwatch
from service.learning.trust import Advice
from service.llm.answers import Completion
from service.mission.mission import Mission
from shared.wire.reasons import Reason
from shared.wire.schemas import Guided, UavState
from shared.world.step_rule import Action

# The part of a deadline reserved for the check, the answer and the event loop.
RESERVE_S = 0.02


@dataclass(frozen=True, slots=True)
class DecisionTask:
    """One UAV's decision at one step.

    Attributes:
        attempt: the number of this request among the UAV's at this step.
        deadline_ms: for the response, from the start of ``watch``.
        deadline: for the LLM and the plan, less the reserve.
        evaluation_deadline: for the rollout evaluator, which may take time that the other UAVs of a batch can spare.
        plan: the task that makes the fleet's plan, if there is one.
        advice: of the LLM, if one query covered the whole batch.
    """

    mission: Mission
    uav: UavState
    step: int
    attempt: int
    deadline_ms: int
    deadline: Deadline
    evaluation_deadline: Deadline
    watch: Stopwatch
    plan: asyncio.Task[None] | None
    advice: LlmAdvice | None = None


@dataclass(frozen=True, slots=True)
class Choice:
    """An action, with the reason if the LLM had no part in it.

    Attributes:
        report: of mode ``guided``: the response's part about trust and candidates.
        advice: of mode ``guided``: the advice from which trust learns.
        unevaluated: the rollout evaluator was late or failed.
    """

    action: Action
    reason: Reason | None
    completion: Completion | None = None
    model: str | None = None
    report: Guided | None = None
    advice: Advice | None = None
    unevaluated: bool = False


@dataclass(frozen=True, slots=True)
class Fallback:
    """A mode has no choice of its own, for this reason; the LLM-free policy decides."""

    reason: Reason
    completion: Completion | None = None
    model: str | None = None
    unevaluated: bool = False

    def to(self, action: Action) -> Choice:
        """The LLM-free policy's action, for this reason."""
        return Choice(action, self.reason, self.completion, self.model, unevaluated=self.unevaluated)
