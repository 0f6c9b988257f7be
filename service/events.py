"""What changes a mission: the journal keeps these, and a restart plays them again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from service.gradient import Sample
from service.packing import pack, unpack
from service.repeats import Answered
from service.rows import Cells
from service.trust import Advice
from shared.wire import Outcome, UavState


@dataclass(frozen=True, slots=True)
class Pending:
    """A decision whose outcome is still to come.

    ``seen`` is the sensor's row as it was then; ``sample`` is None where the modules had no part in the decision.
    """

    decision_id: str
    uav_id: int
    step: int
    sensor_id: int
    velocity: int
    seen: Cells
    sample: Sample | None

    def state_dict(self) -> dict[str, Any]:
        """As plain values and arrays."""
        sample = self.sample
        told = None if sample is None else [sample.features, sample.chosen, sample.approach, sample.velocity]
        names = ("decision_id", "uav_id", "step", "sensor_id", "velocity")
        return {**{name: getattr(self, name) for name in names}, "seen": dict(self.seen), "sample": told}

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Pending:
        """From its ``state_dict``."""
        sample = None if state["sample"] is None else Sample(*state["sample"])
        return cls(**{**state, "sample": sample})


@dataclass(frozen=True, slots=True)
class Counsel:
    """What the advisers said to a decision, of whom one was this LLM."""

    model: str
    advice: Advice


@dataclass(frozen=True, slots=True)
class Reported:
    """A UAV said how things stand, and asks for its next decision."""

    step: int
    uav: UavState


@dataclass(frozen=True, slots=True)
class Decided:
    """A UAV was told what to do, as the answer to this attempt."""

    decision: Pending
    attempt: int
    counsel: Counsel | None


@dataclass(frozen=True, slots=True)
class Settled:
    """What came of a decision, and whether the modules learn from it: under too heavy a load they do not."""

    outcome: Outcome
    taught: bool


@dataclass(frozen=True, slots=True)
class Guided:
    """The operator's guidance stands like this, as :meth:`OperatorGuidance.state_dict` has it."""

    state: dict[str, Any]


# Requests carry more; the outcome that comes with a report is an event of its own, and how it was sent is past.
_REPORT = set(UavState.model_fields) - {"outcome", "base", "uplink"}
# Of an outcome, what the mission's state follows from.
_OUTCOME = set(Outcome.model_fields) - {"round_trip_ms"}

Event = Reported | Decided | Settled | Guided | Answered
Kind = Literal["reported", "decided", "settled", "guided", "answered"]


def unheard(event: Event) -> None:
    """What hears of the events of a mission that nobody keeps."""


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
                counsel = None if body[2] is None else Counsel(body[2][0], Advice(**body[2][1]))
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
