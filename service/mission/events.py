"""The events that change a mission: the journal writes them, and recovery replays them."""

from dataclasses import dataclass
from typing import Any

from service.learning.trust import Advice
from service.mission.decisions import Pending
from service.mission.idempotency import Answered
from service.mission.sensor_readings import PlacedReading
from shared.wire.schemas import Outcome, UavState


@dataclass(frozen=True, slots=True)
class AdviserReport:
    """The advice of all advisers on a decision; the LLM among them is ``model``."""

    model: str
    advice: Advice


@dataclass(frozen=True, slots=True)
class Reported:
    """A UAV reports its state and asks for its next decision."""

    step: int
    uav: UavState


@dataclass(frozen=True, slots=True)
class Decided:
    """A UAV has a decision, as the answer to this attempt."""

    decision: Pending
    attempt: int
    advice: AdviserReport | None


@dataclass(frozen=True, slots=True)
class Settled:
    """A decision has its outcome. ``for_training`` is false under overload, when the modules do not learn from it."""

    outcome: Outcome
    for_training: bool


@dataclass(frozen=True, slots=True)
class GuidanceChanged:
    """The operator's guidance has changed; ``state`` is its :meth:`OperatorGuidance.state_dict`."""

    state: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ReadingsMerged:
    """Sensor readings, each with its step, changed the belief."""

    readings: list[PlacedReading]


Event = Reported | Decided | Settled | GuidanceChanged | Answered | ReadingsMerged


def ignore_event(event: Event) -> None:
    """The listener of a mission without a journal."""
