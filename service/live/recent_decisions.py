"""The newest decisions of all missions, for pages that are opened later; bounded in number and size."""

import time
import uuid
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from service.prompting.prompt import Prompt
from shared.wire.schemas import DecideResponse, Outcome

_MOST = 600
# Characters of the prompts without their static blocks, which a mission's prompts share.
_MOST_CHARACTERS = 4_000_000


@dataclass(frozen=True, slots=True)
class Blocks:
    """A prompt's text without the unpruned state, which may have 2,000 sensors."""

    static: str
    experiences: str
    state: str


@dataclass(slots=True)
class RecentDecision:
    """One decision: its UAV's position in metres, its prompt, its answer and its outcome.

    ``order`` increases with every answer and every outcome; ``outcome_order`` is the outcome's.
    """

    mission_id: str
    position: tuple[float, float]
    prompt: Blocks | None
    answer: DecideResponse
    order: int
    outcome: Outcome | None = None
    outcome_order: int = 0

    @property
    def characters(self) -> int:
        """Characters of the prompt without the static block."""
        return 0 if self.prompt is None else len(self.prompt.experiences) + len(self.prompt.state)

    def summary(self) -> dict[str, Any]:
        """The page's entry for the decision, without the prompt."""
        return {"order": self.order, "position": self.position, "answer": self.answer, "outcome": self.outcome}


class RecentDecisions:
    """Decisions by ID, oldest first. An entry refers to existing objects.

    Attributes:
        decided_at: time of the newest, Unix seconds, to compare with other machines'; 0 before the first.
    """

    def __init__(self) -> None:
        self._decisions: OrderedDict[str, RecentDecision] = OrderedDict()
        self._characters = 0
        self.order = 0
        self.decided_at = 0.0
        self.edge = uuid.uuid4().hex

    def decided(self, position: tuple[float, float], prompt: Prompt, answer: DecideResponse) -> None:
        """Add an answered decision."""
        self.order += 1
        self.decided_at = time.time()
        blocks = Blocks(prompt.static, prompt.experiences, prompt.state)
        decision = RecentDecision(answer.mission_id, position, blocks, answer, self.order)
        self._decisions[answer.decision_id] = decision
        self._characters += decision.characters
        while len(self._decisions) > _MOST:
            _, oldest = self._decisions.popitem(last=False)
            self._characters -= oldest.characters
        if self._characters > _MOST_CHARACTERS:
            self._drop_prompts()

    def outcome_applied(self, outcome: Outcome) -> None:
        """Add the outcome to its decision."""
        if (decision := self._decisions.get(outcome.decision_id)) is not None:
            self.order += 1
            decision.outcome, decision.outcome_order = outcome, self.order

    def of(self, mission_id: str) -> list[RecentDecision]:
        """A mission's decisions, in the order of their answers."""
        return [decision for decision in self._decisions.values() if decision.mission_id == mission_id]

    def find(self, mission_id: str, decision_id: str) -> RecentDecision | None:
        """The mission's decision; None if it is unknown or forgotten."""
        decision = self._decisions.get(decision_id)
        return decision if decision is not None and decision.mission_id == mission_id else None

    def missions(self) -> list[str]:
        """IDs of the missions with decisions here, the one that decided last first."""
        return list(dict.fromkeys(decision.mission_id for decision in reversed(self._decisions.values())))

    def forget(self, mission_id: str) -> None:
        """Forget the decisions of a deleted mission."""
        for decision_id, decision in list(self._decisions.items()):
            if decision.mission_id == mission_id:
                self._characters -= decision.characters
                del self._decisions[decision_id]

    def _drop_prompts(self) -> None:
        """Drop the oldest prompts; their decisions stay."""
        for decision in self._decisions.values():
            if self._characters <= _MOST_CHARACTERS // 2:
                return
            self._characters -= decision.characters
            decision.prompt = None
