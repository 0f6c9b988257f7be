"""What changes a mission: the journal keeps these, and a restart plays them again."""

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
class AdviserReport:
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
    counsel: AdviserReport | None


@dataclass(frozen=True, slots=True)
class Settled:
    """What came of a decision, and whether the modules learn from it: under too heavy a load they do not."""

    outcome: Outcome
    taught: bool


@dataclass(frozen=True, slots=True)
class Guided:
    """The operator's guidance stands like this, as :meth:`OperatorGuidance.state_dict` has it."""

    state: dict[str, Any]


Event = Reported | Decided | Settled | Guided | Answered


def unheard(event: Event) -> None:
    """What hears of the events of a mission that nobody keeps."""
