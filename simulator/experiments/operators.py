"""The operators of experiments: what they write to the edge, what they mean, and what they agree to."""

from __future__ import annotations

import time
from typing import Literal

from shared.guidance import Guidance, GuidanceAnswer, GuidanceState
from simulator.client import EdgeClient
from simulator.records.record import Record

_WAIT_S = 300.0
_POLL_S = 0.2


class Told(Record):
    """A note and what it means."""

    note: str
    meant: Guidance


class Operator(Record):
    """Who says what to the edge; the note of a flight is by its seed, one after another.

    ``says`` is ``nothing``, the ``note`` alone, which then stands in the prompt; the note, of which he confirms
    what the LLM made if that is what he means, and rejects it if not (``agrees``); or the ``structure`` that he means,
    with the note.
    """

    says: Literal["nothing", "note", "agrees", "structure"]
    notes: tuple[Told, ...]

    def told(self, seed: int) -> Told:
        """The note of a flight."""
        return self.notes[seed % len(self.notes)]

    def note(self, seed: int) -> str | None:
        """What goes into the mission's spec."""
        return None if self.says == "nothing" else self.told(seed).note

    def answer(self, edge: EdgeClient, mission_id: str, seed: int) -> GuidanceState:
        """Say what is to be said of the guidance of a mission just made; returns how it flies."""
        meant = self.told(seed).meant
        if self.says == "structure":
            return edge.answer_guidance(mission_id, GuidanceAnswer(guidance=meant)).status
        if self.says == "agrees":
            ends = time.monotonic() + _WAIT_S
            while (told := edge.guidance(mission_id)).status == "compiling" and time.monotonic() < ends:
                time.sleep(_POLL_S)
            if told.status == "proposed":
                answer: Literal["confirm", "reject"] = "confirm" if told.guidance == meant else "reject"
                return edge.answer_guidance(mission_id, GuidanceAnswer(answer=answer)).status
        return edge.guidance(mission_id).status
