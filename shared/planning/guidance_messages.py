"""The wire of the operator's guidance: a mission's guidance with its orders, and the operator's answers."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from shared.planning.orders import MAX_WISHES, Clock, Guidance, OrderName
from shared.wire.schemas import MissionId, Note
from shared.wire.strict_models import Received, Wire

# `none`: neither a note nor a structure of the operator's.
GuidanceState = Literal["none", "compiling", "proposed", "confirmed", "rejected", "failed"]
EndOfOrder = Literal["its own end", "withdrawn", "replaced"]


class OrderRecord(Wire):
    """An order that was in force, from when to when; it ends where ``until`` is set."""

    name: OrderName
    in_words: str
    note: str | None = Field(description="the note that it was read in; null if it was given as a structure")
    since_step: int = Field(description="the first step under the order")
    since: Clock
    until_step: int | None = Field(None, description="the first step no longer under it; null while it is in force")
    until: Clock | None = None
    why: EndOfOrder | None = Field(None, description="why it ended; `replaced`: a confirmation contradicted it")


class GuidanceStatus(Wire):
    """``GET /missions/{id}/guidance``: the operator's note, the guidance from it, and its status.

    The edge obeys only ``confirmed`` guidance. The compact prompt shows ``proposed`` guidance too, which the LLM alone
    decides by in mode ``llm``.
    """

    mission_id: MissionId
    status: GuidanceState
    note: str | None = None
    guidance: Guidance | None = Field(None, description="compiled from the note, or given by the operator")
    in_words: str | None = Field(None, description="the guidance in plain English, from the structure alone")
    obeyed_in_words: str | None = Field(None, description="the orders that are obeyed now, in plain English")
    origin: Literal["llm", "phrases", "operator"] | None = Field(
        None, description="the author of the structure; `phrases`: the edge read the whole note, without the LLM"
    )
    model: str | None = Field(None, description="the LLM that compiled the note")
    failure: str | None = Field(None, description="why the note could not be compiled")
    doubts: list[str] = Field([], description="what may be wrong with the LLM's reading; empty if it is certain")
    begins: list[str] = Field([], description="the orders that begin when `guidance` is confirmed, each in words")
    stays: list[str] = Field([], description="the orders in force that stay when `guidance` is confirmed (`add`)")
    ends: list[str] = Field([], description="the orders in force that end when `guidance` is confirmed (`add`)")
    ends_if_replaced: list[str] = Field(
        [], description="the orders in force that end when it is confirmed as `replace`"
    )
    begun: list[str] = Field([], description="the orders that began when those in force last changed, each in words")
    ended: list[str] = Field([], description="the orders that ended when those in force last changed, each in words")
    orders: list[OrderRecord] = Field(
        [], description="the orders in force, and before them the newest 1,000 ended ones"
    )
    version: str = Field("", description="another one after every change; an answer may name the one that it answers")


class GuidanceAnswer(Received):
    """``POST /missions/{id}/guidance``: confirm or reject the compiled guidance, replace it, or withdraw orders.

    A new note is compiled, and obeyed once it is confirmed; until then the orders before it stay. A given structure
    counts as confirmed. It needs neither an LLM nor a note. Both are added to the orders in force, or replace them.
    `withdraw` ends the orders in force, whatever has become of the note; `reject` does the same where the proposal was
    confirmed.
    """

    answer: Literal["confirm", "reject", "withdraw"] | None = None
    guidance: Guidance | None = None
    note: Note | None = Field(
        None, description="a new note in plain words; a long prompt keeps the text of the mission's first one"
    )
    change: Literal["add", "replace"] | None = Field(
        None,
        description="with `guidance` or `confirm`. `add`, the default: the orders in force stay, except those that the "
        "new ones contradict; `replace`: all others end",
    )
    orders: list[Annotated[str, Field(max_length=80)]] | None = Field(
        None,
        min_length=1,
        max_length=MAX_WISHES,
        description="with `withdraw`: only these end, by name; `visit:kp-1.58` for the sensor of this name too",
    )
    version: str | None = Field(
        None, max_length=64, description="the status's `version`: the answer gets 409 if the guidance has changed since"
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if [self.answer, self.guidance, self.note].count(None) != 2:
            raise ValueError("give one of answer, guidance and note")
        if self.change and self.guidance is None and self.answer != "confirm":
            raise ValueError("change goes with guidance or with the answer confirm")
        if self.orders and self.answer != "withdraw":
            raise ValueError("orders goes with the answer withdraw")
        return self
