"""Events as bytes, and back: the journal's file format."""

from __future__ import annotations

from typing import Literal

from service.learning.trust import Advice
from service.mission.events import AdviserReport, Decided, Event, Guided, Pending, Reported, Settled
from service.mission.idempotency import Answered
from service.storage.serialization import pack, unpack
from shared.wire import Outcome, UavState

# Requests carry more; the outcome that comes with a report is an event of its own, and how it was sent is past.
_REPORT = set(UavState.model_fields) - {"outcome", "base", "uplink"}
# Of an outcome, what the mission's state follows from.
_OUTCOME = set(Outcome.model_fields) - {"round_trip_ms"}

Kind = Literal["reported", "decided", "settled", "guided", "answered"]


def encode(event: Event) -> tuple[Kind, bytes]:
    """An event's kind, and the rest of it as bytes."""
    match event:
        case Reported(step, uav):
            return "reported", pack([step, uav.model_dump(include=_REPORT, exclude_defaults=True)])
        case Decided(decision, attempt, counsel):
            told = None if counsel is None else [counsel.model, counsel.advice.state_dict()]
            return "decided", pack([decision.state_dict(), attempt, told])
        case Settled(outcome, taught):
            return "settled", pack([outcome.model_dump(include=_OUTCOME), taught])
        case Guided(state):
            return "guided", pack(state)
        case Answered(key, digest, body):
            return "answered", pack([key, digest, body])


def decode(kind: str, data: bytes) -> Event:
    """The event; raises ``ValueError`` for what is none."""
    try:
        body = unpack(data)
        match kind:
            case "reported":
                return Reported(body[0], UavState.model_validate(body[1]))
            case "decided":
                counsel = None if body[2] is None else AdviserReport(body[2][0], Advice(**body[2][1]))
                return Decided(Pending.of(body[0]), body[1], counsel)
            case "settled":
                return Settled(Outcome.model_validate(body[0]), body[1])
            case "guided":
                return Guided(body)
            case "answered":
                return Answered(*body)
    except (AttributeError, IndexError, KeyError, TypeError) as damaged:
        raise ValueError(f"damaged event {kind}: {damaged}") from damaged
    raise ValueError(f"unknown event {kind}")
