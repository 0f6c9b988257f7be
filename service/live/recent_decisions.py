"""The newest decisions of all missions, so that a page opened late shows what was flown; bounded in number and size."""

from __future__ import annotations

import uuid
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from service.prompting.prompt import Prompt
from shared.wire import DecideResponse, Outcome

_MOST = 600
# Of the prompts' text, without the static blocks, which a mission's prompts share.
_MOST_CHARACTERS = 4_000_000


@dataclass(frozen=True, slots=True)
class Blocks:
    """A prompt's text, without what it would be uncompressed: that is a state of up to 10,000 sensors."""

    static: str
    experiences: str
    state: str


@dataclass(slots=True)
class RecentDecision:
    """One decision: where its UAV was, m, what was asked, what was answered, and what came of it.

    ``order`` counts up with every answer and every outcome; ``settled`` is the order at which the outcome came.
    """

    mission_id: str
    position: tuple[float, float]
    prompt: Blocks | None
    answer: DecideResponse
    order: int
    outcome: Outcome | None = None
    settled: int = 0

    @property
    def characters(self) -> int:
        """Of the prompt, without the static block."""
        return 0 if self.prompt is None else len(self.prompt.experiences) + len(self.prompt.state)

    def told(self) -> dict[str, Any]:
        """For the page, but for the prompt."""
        return {"order": self.order, "position": self.position, "answer": self.answer, "outcome": self.outcome}


class RecentDecisions:
    """By decision, oldest first. Keeping one costs references to what is there anyway: nothing is made."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, RecentDecision] = OrderedDict()
        self._characters = 0
        self.order = 0
        self.edge = uuid.uuid4().hex

    def decided(self, position: tuple[float, float], prompt: Prompt, answer: DecideResponse) -> None:
        """Take a decision that is answered."""
        self.order += 1
        blocks = Blocks(prompt.static, prompt.experiences, prompt.state)
        kept = RecentDecision(answer.mission_id, position, blocks, answer, self.order)
        self._kept[answer.decision_id] = kept
        self._characters += kept.characters
        while len(self._kept) > _MOST:
            _, oldest = self._kept.popitem(last=False)
            self._characters -= oldest.characters
        if self._characters > _MOST_CHARACTERS:
            self._shed_prompts()

    def settled(self, outcome: Outcome) -> None:
        """This came of it."""
        if (kept := self._kept.get(outcome.decision_id)) is not None:
            self.order += 1
            kept.outcome, kept.settled = outcome, self.order

    def of(self, mission_id: str) -> list[RecentDecision]:
        """A mission's decisions, in the order of their answers."""
        return [kept for kept in self._kept.values() if kept.mission_id == mission_id]

    def find(self, mission_id: str, decision_id: str) -> RecentDecision | None:
        """The mission's decision, if it is still kept."""
        kept = self._kept.get(decision_id)
        return kept if kept is not None and kept.mission_id == mission_id else None

    def newest_first(self) -> list[str]:
        """Missions that decisions are kept of."""
        return list(dict.fromkeys(kept.mission_id for kept in reversed(self._kept.values())))

    def forget(self, mission_id: str) -> None:
        """Its mission was deleted."""
        for decision_id, kept in list(self._kept.items()):
            if kept.mission_id == mission_id:
                self._characters -= kept.characters
                del self._kept[decision_id]

    def _shed_prompts(self) -> None:
        """The oldest prompts go first; their decisions stay."""
        for kept in self._kept.values():
            if self._characters <= _MOST_CHARACTERS // 2:
                return
            self._characters -= kept.characters
            kept.prompt = None
