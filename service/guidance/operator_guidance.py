"""One mission's operator guidance: the note, what was understood of it, and what is obeyed once the operator agrees."""

from __future__ import annotations

from typing import Any, Literal

from service.errors import Conflict, Refused
from shared.guidance import NO_GUIDANCE, Guidance, GuidanceAnswer, GuidanceState, GuidanceStatus, Impossible
from shared.scenario import Scenario


class OperatorGuidance:
    """From a note to what is obeyed: compiling, then proposed or failed, then confirmed or rejected.

    The operator's own structure is confirmed by being given, at any time; what an LLM makes of the note after that is
    not heard.

    Attributes:
        obeyed: what planners and scores obey now; asks for nothing until something is confirmed.
    """

    def __init__(self, note: str | None, scenario: Scenario) -> None:
        self.note = note
        self.status: GuidanceState = "none" if note is None else "compiling"
        self.confirmed: Guidance = NO_GUIDANCE
        self._scenario = scenario
        self._understood: Guidance | None = None
        self._origin: Literal["llm", "operator"] | None = None
        self._model: str | None = None
        self._failure: str | None = None

    def propose(self, guidance: Guidance, model: str | None) -> None:
        """An LLM made this of the note; nothing but the operator's word makes it obeyed."""
        if self.status == "compiling":
            self.status, self._understood, self._origin, self._model = "proposed", guidance, "llm", model

    def fail(self, why: str, model: str | None) -> None:
        """Nothing could be made of the note."""
        if self.status == "compiling":
            self.status, self._failure, self._model = "failed", why, model

    def answer(self, answer: GuidanceAnswer) -> None:
        """The operator's word; it is obeyed from the next decision on.

        Raises:
            Conflict: there is nothing to confirm or reject.
            Refused: the operator's own structure cannot be obeyed; what was obeyed before still is.
        """
        if answer.guidance is not None:
            try:
                answer.guidance.check(self._scenario)
            except Impossible as error:
                raise Refused(f"guidance.{error.field}", error.detail) from None
            self._understood, self._origin, self._failure = answer.guidance, "operator", None
        elif self._understood is None:
            raise Conflict(
                "answer", f"guidance is {self.status}: there is nothing to {answer.answer}; give `guidance` of your own"
            )
        confirmed = answer.answer != "reject"
        self.status = "confirmed" if confirmed else "rejected"
        self.confirmed = self._understood if confirmed else NO_GUIDANCE

    def told(self, mission_id: str) -> GuidanceStatus:
        """What ``GET /missions/{id}/guidance`` says."""
        return GuidanceStatus(
            mission_id=mission_id,
            status=self.status,
            note=self.note,
            guidance=self._understood,
            in_words=None if self._understood is None else self._understood.in_words(),
            origin=self._origin,
            model=self._model,
            failure=self._failure,
        )

    def state_dict(self) -> dict[str, Any]:
        """Where it stands, as plain values."""
        return {
            "status": self.status,
            "obeyed": self.confirmed.model_dump(),
            "understood": None if self._understood is None else self._understood.model_dump(),
            "origin": self._origin,
            "model": self._model,
            "failure": self._failure,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it stood when the state was taken."""
        self.status = state["status"]
        self.confirmed = Guidance.model_validate(state["obeyed"])
        understood = state["understood"]
        self._understood = None if understood is None else Guidance.model_validate(understood)
        self._origin, self._model, self._failure = state["origin"], state["model"], state["failure"]
