"""One mission's operator's guidance: the note, the guidance proposed from it, and the confirmed guidance."""

import hashlib
from collections.abc import Sequence
from typing import Any, Literal

from service.errors import Conflict, Refused
from shared.planning.orders import NO_GUIDANCE, Guidance, GuidanceAnswer, GuidanceState, GuidanceStatus, Impossible
from shared.world.scenario import Scenario


class OperatorGuidance:
    """The life of a note: compiling, then proposed or failed, then confirmed or rejected.

    The operator may give a structure at any time, which is confirmed at once. A proposal that an LLM makes afterwards
    is ignored. A new note begins this life again; the orders that were confirmed before stay until the operator
    confirms the new ones, or withdraws them; a rejected proposal leaves them as they are.

    Attributes:
        confirmed: the guidance that planner and scores follow; empty until the operator confirms one.
        orders: the same; None if it orders nothing.
    """

    def __init__(self, note: str | None, scenario: Scenario) -> None:
        self.note = note
        self.status: GuidanceState = "none" if note is None else "compiling"
        self._begun: list[str] = []
        self._ended: list[str] = []
        self._obey(NO_GUIDANCE)
        self._scenario = scenario
        self._proposed: Guidance | None = None
        self._origin: Literal["llm", "operator"] | None = None
        self._model: str | None = None
        self._failure: str | None = None
        self._doubts: list[str] = []

    def propose(self, guidance: Guidance, model: str | None, doubts: Sequence[str] = ()) -> None:
        """Propose the guidance that an LLM made of the note; until the operator confirms it, only a prompt shows it."""
        if self.status == "compiling":
            self.status, self._proposed, self._origin, self._model = "proposed", guidance, "llm", model
            self._doubts = list(doubts)

    def fail(self, reason: str, model: str | None) -> None:
        """Record that the note was not compiled."""
        if self.status == "compiling":
            self.status, self._failure, self._model = "failed", reason, model

    def answer(self, answer: GuidanceAnswer) -> None:
        """Apply the operator's answer, which takes effect with the next decision.

        Raises:
            Conflict: there is nothing to confirm or reject, or the guidance is no longer that of the answer's version.
            Refused: the fleet cannot follow the operator's structure; the guidance stays as it is.
        """
        if answer.version not in (None, self.version):
            raise Conflict("version", "the guidance has changed since this version: read it again, then answer")
        if answer.note is not None:
            self.note, self.status = answer.note, "compiling"
            self._proposed = self._origin = self._model = self._failure = None
            self._doubts = []
        elif answer.guidance is not None:
            try:
                answer.guidance.check(self._scenario)
            except Impossible as error:
                raise Refused(f"guidance.{error.field}", error.detail) from None
            self._proposed, self._origin, self._failure = answer.guidance, "operator", None
            self._doubts = []
            self._confirm(answer.guidance)
        elif answer.answer == "withdraw" or (answer.answer == "reject" and self.orders and self.status != "proposed"):
            self._withdraw()
        elif self._proposed is None:
            raise Conflict(
                "answer", f"guidance is {self.status}: there is nothing to {answer.answer}; give `guidance` of your own"
            )
        elif answer.answer == "confirm":
            self._confirm(self._proposed)
        else:
            self.status = "rejected"

    def _confirm(self, guidance: Guidance) -> None:
        self.status = "confirmed"
        self._change(guidance)

    def _withdraw(self) -> None:
        # A note that is being read, was not understood or waits for an answer stays as it is.
        if self.status == "confirmed":
            self.status = "rejected"
        self._change(NO_GUIDANCE)

    def _change(self, guidance: Guidance) -> None:
        begun, ended = guidance.beyond(self.confirmed), self.confirmed.beyond(guidance)
        if begun or ended:
            self._begun, self._ended = begun, ended
        self._obey(guidance)

    def _obey(self, guidance: Guidance) -> None:
        self.confirmed = guidance
        self.orders = guidance or None

    @property
    def version(self) -> str:
        """A digest of the whole state, which a restart does not change."""
        return hashlib.sha256(repr(self.state_dict()).encode()).hexdigest()[:16]

    @property
    def read(self) -> Guidance | None:
        """The orders that a prompt shows: ``orders``, merged with a reading that awaits an answer."""
        if self.status != "proposed" or not self._proposed:
            return self.orders
        return self._proposed.merged_with(self.confirmed, self._scenario.max_velocity + 1)

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
            begins=[] if self._proposed is None else self._proposed.beyond(self.confirmed),
            ends=[] if self._proposed is None else self.confirmed.beyond(self._proposed),
            begun=self._begun,
            ended=self._ended,
            version=self.version,
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
            "begun": self._begun,
            "ended": self._ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.note = state["note"]
        self.status = state["status"]
        self._obey(Guidance.model_validate(state["obeyed"]))
        proposed = state["understood"]
        self._proposed = None if proposed is None else Guidance.model_validate(proposed)
        self._origin, self._model, self._failure = state["origin"], state["model"], state["failure"]
        self._doubts = state["doubts"]
        self._begun, self._ended = state["begun"], state["ended"]
