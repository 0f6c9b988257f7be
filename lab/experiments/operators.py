"""The operators of experiments: their notes to the edge, the guidance intended, and their answers."""

from __future__ import annotations

import time
from typing import Literal

from shared.client.edge_client import EdgeClient
from shared.planning.guidance_messages import GuidanceAnswer, GuidanceState
from shared.planning.orders import Guidance
from simulator.records.decision import Record

_WAIT_S = 300.0
_POLL_S = 0.2


class Intent(Record):
    """A note and the guidance intended by it."""

    note: str
    meant: Guidance


class Operator(Record):
    """An operator; a flight's seed selects its note.

    ``says`` is ``nothing``; the ``note`` alone, which the prompt then has; ``agrees``, the note with the LLM's
    compilation confirmed if it equals the intended guidance and rejected otherwise; or ``structure``, the note with the
    intended guidance as a structure. The flight begins once the LLM has read the note, within the first step of a fleet
    in real time.
    """

    says: Literal["nothing", "note", "agrees", "structure"]
    notes: tuple[Intent, ...]

    def intent(self, seed: int) -> Intent:
        """The note of a flight, with its meaning."""
        return self.notes[seed % len(self.notes)]

    def note(self, seed: int) -> str | None:
        """The note in the mission's spec."""
        return None if self.says == "nothing" else self.intent(seed).note

    def answer(self, edge: EdgeClient, mission_id: str, seed: int) -> GuidanceState:
        """Answer the guidance of a new mission; returns the state of its guidance."""
        meant = self.intent(seed).meant
        if self.says == "structure":
            return edge.answer_guidance(mission_id, GuidanceAnswer(guidance=meant)).status
        if self.says != "nothing":
            deadline = time.monotonic() + _WAIT_S
            while (compiled := edge.guidance(mission_id)).status == "compiling" and time.monotonic() < deadline:
                time.sleep(_POLL_S)
            if self.says == "agrees" and compiled.status == "proposed":
                answer: Literal["confirm", "reject"] = "confirm" if compiled.guidance == meant else "reject"
                return edge.answer_guidance(mission_id, GuidanceAnswer(answer=answer)).status
        return edge.guidance(mission_id).status
