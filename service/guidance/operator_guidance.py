"""One mission's operator's guidance: the note, the guidance proposed from it, and the confirmed guidance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from service.errors import Conflict, Refused
from shared.guidance import NO_GUIDANCE, Guidance, GuidanceAnswer, GuidanceState, GuidanceStatus, Impossible
from shared.scenario import Scenario


class OperatorGuidance:
    """The life of a note: compiling, then proposed or failed, then confirmed or rejected.

    The operator may give a structure at any time, which is confirmed at once. A proposal that an LLM makes afterwards
    is ignored. A new note begins this life again; the orders that were confirmed before stay until the operator
    confirms the new ones, and a rejected proposal leaves them as they are.

    Attributes:
        confirmed: the guidance that planner and scores follow; empty until the operator confirms one.
        orders: the same; None where it orders nothing.
    """

    def __init__(self, note: str | None, scenario: Scenario) -> None:
        self.note = note
        self.status: GuidanceState = "none" if note is None else "compiling"
        self._obey(NO_GUIDANCE)
        self._scenario = scenario
        self._proposed: Guidance | None = None
        self._origin: Literal["llm", "operator"] | None = None
        self._model: str | None = None
        self._failure: str | None = None
        self._doubts: list[str] = []

    def propose(self, guidance: Guidance, model: str | None, doubts: Sequence[str] = ()) -> None:
        """Propose the guidance that an LLM made of the note; until the operator confirms it, a prompt alone has it."""
        if self.status == "compiling":
            self.status, self._proposed, self._origin, self._model = "proposed", guidance, "llm", model
            self._doubts = list(doubts)

    def fail(self, reason: str, model: str | None) -> None:
        """Note that the note was not compiled."""
        if self.status == "compiling":
            self.status, self._failure, self._model = "failed", reason, model

    def answer(self, answer: GuidanceAnswer) -> None:
        """Apply the operator's answer, which takes effect with the next decision.

        Raises:
            Conflict: there is nothing to confirm or reject.
            Refused: the fleet cannot follow the operator's structure; the guidance stays as it is.
        """
        if answer.note is not None:
            self.note, self.status = answer.note, "compiling"
            self._proposed = self._origin = self._model = self._failure = None
            self._doubts = []
            return
        if answer.guidance is not None:
            try:
                answer.guidance.check(self._scenario)
            except Impossible as error:
                raise Refused(f"guidance.{error.field}", error.detail) from None
            self._proposed, self._origin, self._failure = answer.guidance, "operator", None
            self._doubts = []
        elif self._proposed is None:
            raise Conflict(
                "answer", f"guidance is {self.status}: there is nothing to {answer.answer}; give `guidance` of your own"
            )
        if answer.answer != "reject":
            self.status = "confirmed"
            self._obey(self._proposed)
            return
        if self.status != "proposed":
            self._obey(NO_GUIDANCE)
        self.status = "rejected"

    def _obey(self, guidance: Guidance) -> None:
        self.confirmed = guidance
        self.orders = guidance or None

    @property
    def read(self) -> Guidance | None:
        """The orders that a prompt shows: ``orders``, and beside them a reading that nobody has answered yet."""
        if self.status != "proposed" or not self._proposed:
            return self.orders
        return self._proposed.beside(self.confirmed, self._scenario.max_velocity + 1)

    def report(self, mission_id: str) -> GuidanceStatus:
        """The body of ``GET /missions/{id}/guidance``."""
        return GuidanceStatus(
            mission_id=mission_id,
            status=self.status,
            note=self.note,
            guidance=self._proposed,
            in_words=None if self._proposed is None else self._proposed.in_words(),
            obeyed_in_words=None if self.orders is None else self.orders.in_words(),
            origin=self._origin,
            model=self._model,
            failure=self._failure,
            doubts=self._doubts,
        )

    def state_dict(self) -> dict[str, Any]:
        """Status, proposal and confirmed guidance, as plain values."""
        return {
            "note": self.note,
            "status": self.status,
            "obeyed": self.confirmed.model_dump(),
            "understood": None if self._proposed is None else self._proposed.model_dump(),
            "origin": self._origin,
            "model": self._model,
            "failure": self._failure,
            "doubts": self._doubts,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        # Journals of earlier versions have no note: theirs is the spec's.
        self.note = state.get("note", self.note)
        self.status = state["status"]
        self._obey(Guidance.model_validate(state["obeyed"]))
        proposed = state["understood"]
        self._proposed = None if proposed is None else Guidance.model_validate(proposed)
        self._origin, self._model, self._failure = state["origin"], state["model"], state["failure"]
        self._doubts = state.get("doubts", [])
