"""One mission's operator's guidance: the note, the guidance proposed from it, and the confirmed guidance."""

import hashlib
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime
from fnmatch import filter as matching
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service.errors import Conflict, Refused
from shared.planning.guidance_messages import EndOfOrder, GuidanceAnswer, GuidanceState, GuidanceStatus, OrderRecord
from shared.planning.orders import NO_GUIDANCE, End, Guidance, Impossible, once
from shared.wire.names import Names, with_names
from shared.wire.schemas import MAX_STEP
from shared.world.scenario import Scenario

# Most ended orders in memory.
_MOST_ENDED = 1000
_ANSWERED = ("confirmed", "rejected")
# Private attributes that are plain values of the state.
_STATE = ("withdrawn", "origin", "model", "failure", "doubts", "begun", "ended")


class OperatorGuidance:
    """The life of a note: compiling, then proposed or failed, then confirmed or rejected.

    The operator may give a structure at any time, which is confirmed at once. A proposal that an LLM makes afterwards
    is ignored. A new note begins this life again. New orders are added to those in force, and replace only those that
    they contradict, unless the operator confirms them as a replacement of all. A note may also withdraw orders.

    Attributes:
        confirmed: the guidance that planner and scores follow; empty until the operator confirms one.
        orders: the same; None if it orders nothing.
    """

    def __init__(self, note: str | None, scenario: Scenario) -> None:
        self.note = note
        self.status: GuidanceState = "none" if note is None else "compiling"
        self._in_force: dict[str, OrderRecord] = {}
        self._over: deque[OrderRecord] = deque(maxlen=_MOST_ENDED)
        self._withdrawn: list[str] = []
        self._begun: list[str] = []
        self._ended: list[str] = []
        self._obey(NO_GUIDANCE)
        self._scenario = scenario
        self._proposed: Guidance | None = None
        self._origin: Literal["llm", "phrases", "operator"] | None = None
        self._model: str | None = None
        self._failure: str | None = None
        self._doubts: list[str] = []

    def propose(
        self, guidance: Guidance, model: str | None, doubts: Sequence[str] = (), withdrawn: Sequence[str] = ()
    ) -> None:
        """Propose the guidance that was read in the note; until the operator confirms it, only a prompt shows it.

        Args:
            withdrawn: patterns of the names of orders in force that the note withdraws.
        """
        if self.status == "compiling":
            self.status, self._proposed, self._model = "proposed", guidance, model
            self._origin = "llm" if model else "phrases"
            self._doubts, self._withdrawn = list(doubts), list(withdrawn)
            if model:
                both = {*guidance.each_in_words().values()} & {*self.confirmed.each_in_words().values()}
                self._doubts += [f"In force already: “{order}” If the note ends it, withdraw it." for order in both]

    def fail(self, reason: str, model: str | None) -> None:
        """Record that the note was not compiled."""
        if self.status == "compiling":
            self.status, self._failure, self._model = "failed", reason, model

    def answer(self, answer: GuidanceAnswer, step: int) -> None:
        """Apply the operator's answer, which takes effect with the next decision.

        Args:
            step: the first step whose decisions all follow it.

        Raises:
            Conflict: there is nothing to confirm, reject or withdraw, the fleet cannot follow the proposal any more, or
                the guidance is no longer that of the answer's version.
            Refused: the fleet cannot follow the operator's structure; the guidance stays as it is.
        """
        if answer.version not in (None, self.version):
            raise Conflict("version", "the guidance has changed since this version: read it again, then answer")
        replaces = answer.change == "replace"
        if answer.note is not None:
            self.note, self.status = answer.note, "compiling"
            self._proposed = self._origin = self._model = self._failure = None
            self._doubts, self._withdrawn = [], []
        elif answer.guidance is not None:
            try:
                self._change(self._with(answer.guidance, (), replaces, step), step)
            except Impossible as error:
                raise Refused(f"guidance.{error.field}", error.detail) from None
            self._proposed, self._origin, self._failure = answer.guidance, "operator", None
            self._doubts, self._withdrawn, self.status = [], [], "confirmed"
        elif answer.answer == "withdraw" or (answer.answer == "reject" and self.orders and self.status == "confirmed"):
            self._withdraw(answer.orders, step)
        elif self._proposed is None:
            todo = "wait until the note is read" if self.status == "compiling" else "give `guidance` of your own"
            raise Conflict("answer", f"guidance is {self.status}: there is nothing to {answer.answer}; {todo}")
        elif answer.answer == "confirm":
            note = self.note if self._origin != "operator" else None
            try:
                self._change(self._with(self._proposed, self._withdrawn, replaces, step), step, note)
            except Impossible as error:
                raise Conflict("answer", str(error)) from None
            self.status = "confirmed"
        else:
            self.status = "rejected"

    def expire(self, step: int, first: int, visits: NDArray[np.int64]) -> bool:
        """End the orders whose end has come before a decision of this step; returns whether there are any.

        Args:
            first: the first step whose decisions are all without them.
            visits: the step of each sensor's last visit that succeeded, by sensor ID; -1 for never.
        """
        if not self.confirmed.ends:
            return False
        now = datetime.now(UTC)
        over = [
            name
            for name, end in self.confirmed.ends.items()
            if (end.step is not None and step >= end.step)
            or (end.time is not None and now >= end.time)
            or (end.visited is not None and visits[end.visited] >= self._in_force[name].since_step)
        ]
        if over:
            self._change(self.confirmed.without(over), first, why="its own end")
        return bool(over)

    def _with(self, guidance: Guidance, withdrawn: Sequence[str], replaces: bool, step: int = 0) -> Guidance:
        """The orders in force after this guidance is given; raises :class:`Impossible`."""
        guidance.check(self._scenario)
        for name, end in guidance.ends.items():
            if end.step is not None and end.step <= step > 0:
                raise Impossible(f"ends.{name}.step", f"the mission is at step {step} already")
            if end.time is not None and end.time <= datetime.now(UTC):
                raise Impossible(f"ends.{name}.time", "this time has passed")
        kept = NO_GUIDANCE if replaces else self.confirmed.without(self._matching(withdrawn))
        # An order for some steps is counted from here on.
        ends = {n: e if e.steps is None else End(step=min(step + e.steps, MAX_STEP)) for n, e in guidance.ends.items()}
        return Guidance.of(guidance.values, ends).added_to(kept, self._scenario.max_velocity + 1)

    def _matching(self, patterns: Sequence[str]) -> set[str]:
        return {name for pattern in patterns for name in matching(self._in_force, pattern)}

    def _withdraw(self, names: Collection[str] | None, step: int) -> None:
        if unknown := set(names or ()) - self._in_force.keys():
            raise Conflict("orders", f"no order {min(unknown)} is in force, but {', '.join(self._in_force) or 'none'}")
        # A note that is being read, was not understood or waits for an answer stays as it is.
        left = NO_GUIDANCE if names is None else self.confirmed.without(names)
        if self.status == "confirmed" and not left:
            self.status = "rejected"
        self._change(left, step, why="withdrawn")

    def _change(self, guidance: Guidance, step: int, note: str | None = None, why: EndOfOrder = "replaced") -> None:
        begun, ended = guidance.beyond(self.confirmed), self.confirmed.beyond(guidance)
        if begun or ended:
            self._begun, self._ended = begun, ended
        now = datetime.now(UTC).replace(microsecond=0)
        words = guidance.each_in_words()
        over = [name for name, record in self._in_force.items() if words.get(name) != record.in_words]
        for name in over:
            record = self._in_force.pop(name)
            until = {"until_step": max(step, record.since_step), "until": now, "why": why}
            self._over.append(record.model_copy(update=until))
        if why != "replaced" and self._proposed is not None and self.status in _ANSWERED:
            # A repeated confirmation does not bring them back.
            self._proposed = self._proposed.without(over) or None
        for name, order in words.items():
            if name not in self._in_force:
                self._in_force[name] = OrderRecord(name=name, in_words=order, note=note, since_step=step, since=now)
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

    def report(self, mission_id: str, names: Names | None = None) -> GuidanceStatus:
        """The body of ``GET /missions/{id}/guidance``, with the user's names in the orders' words."""
        named = partial(with_names, names=names)
        waits = self._proposed if self.status != "confirmed" else None
        after = self.confirmed if waits is None else self._after(waits)
        changed = {} if waits is None else self._changes(waits, after)
        in_words = None if self._proposed is None else self._proposed.in_words()
        if in_words and not self._proposed and (self._withdrawn or self.confirmed):
            in_words = "No new order."
        records = (*self._over, *self._in_force.values())
        return GuidanceStatus(
            mission_id=mission_id,
            status=self.status,
            note=self.note,
            guidance=self._proposed,
            in_words=in_words and named(in_words),
            obeyed_in_words=None if self.orders is None else named(self.orders.in_words()),
            origin=self._origin,
            model=self._model,
            failure=self._failure,
            doubts=[*self._doubts, *self._doubts_of(after)],
            **{key: list(map(named, change)) for key, change in changed.items()},
            begun=list(map(named, self._begun)),
            ended=list(map(named, self._ended)),
            orders=[one.model_copy(update={"in_words": named(one.in_words)}) for one in records],
            version=self.version,
        )

    def _doubts_of(self, after: Guidance) -> Iterator[str]:
        """What code doubts of the orders that are in force after a confirmation."""
        if self.status == "proposed" and self._withdrawn and not self._matching(self._withdrawn):
            yield "The orders that the note withdraws are not in force."
        for name, order in self.confirmed.each_in_words().items():
            if name in after.ends and after.values[name] != self.confirmed.values[name]:
                yield f"“{order}” ends too, and does not come back."
        periods = {f"visit:{wish.sensor_id}": wish.visit_every for wish in after.sensors if wish.visit_every}
        needed = sum(1 / every for name, every in periods.items() if not once(name, every, after.ends.get(name)))
        if needed > (uavs := self._scenario.uavs):
            yield f"The visits need {needed:.1f} UAVs in every step, and there are {uavs}: some will be late."

    def _after(self, proposed: Guidance) -> Guidance:
        """The orders in force after a confirmation."""
        try:
            return self._with(proposed, self._withdrawn, replaces=False)
        except Impossible:
            return proposed

    def _changes(self, proposed: Guidance, after: Guidance) -> dict[str, list[str]]:
        """What a confirmation would change, each order in words."""
        ends = self.confirmed.beyond(after)
        return {
            "begins": proposed.beyond(self.confirmed),
            "stays": [order for order in self.confirmed.each_in_words().values() if order not in ends],
            "ends": ends,
            "ends_if_replaced": self.confirmed.beyond(proposed),
        }

    def state_dict(self) -> dict[str, Any]:
        """Status, proposal and confirmed guidance, as plain values."""
        return {
            "note": self.note,
            "status": self.status,
            "obeyed": self.confirmed.model_dump(mode="json"),
            "understood": None if self._proposed is None else self._proposed.model_dump(mode="json"),
            "orders": [record.model_dump(mode="json") for record in (*self._over, *self._in_force.values())],
            **{name: getattr(self, f"_{name}") for name in _STATE},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.note = state["note"]
        self.status = state["status"]
        self._obey(Guidance.model_validate(state["obeyed"]))
        proposed = state["understood"]
        self._proposed = None if proposed is None else Guidance.model_validate(proposed)
        for name in _STATE:
            setattr(self, f"_{name}", state[name])
        records = [OrderRecord.model_validate(record) for record in state["orders"]]
        self._over = deque((record for record in records if record.until is not None), maxlen=_MOST_ENDED)
        self._in_force = {record.name: record for record in records if record.until is None}
