"""The events that change a mission: the journal writes them, and a restart applies them again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.learning.modules import Sample
from service.learning.trust import Advice
from service.mission.idempotency import Answered
from service.prompting.row_formats import Cells
from shared.wire import Outcome, UavState


@dataclass(frozen=True, slots=True)
class Pending:
    """A decision whose outcome is still to come.

    Attributes:
        seen: the chosen sensor's row at the decision.
        sample: the training sample; None where the modules had no part in the decision.
    """

    decision_id: str
    uav_id: int
    step: int
    sensor_id: int
    velocity: int
    seen: Cells
    sample: Sample | None

    def state_dict(self) -> dict[str, Any]:
        """Plain values and arrays."""
        sample = self.sample
        fields = None if sample is None else [sample.features, sample.chosen, sample.approach, sample.velocity]
        names = ("decision_id", "uav_id", "step", "sensor_id", "velocity")
        return {**{name: getattr(self, name) for name in names}, "seen": dict(self.seen), "sample": fields}

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Pending:
        """From its ``state_dict``."""
        sample = None if state["sample"] is None else Sample(*state["sample"])
        return cls(**{**state, "sample": sample})


@dataclass(frozen=True, slots=True)
class AdviserReport:
    """The advice of all advisers on a decision, of which this LLM is one."""

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
class Guided:
    """The operator's guidance has changed; ``state`` is its :meth:`OperatorGuidance.state_dict`."""

    state: dict[str, Any]


Event = Reported | Decided | Settled | Guided | Answered


def ignore_event(event: Event) -> None:
    """The listener of a mission without a journal."""
