"""A mission's flight as it is recorded: its decisions, each step's losses, the sensors' and UAVs' states."""

from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from shared.client.calls import Exchange
from shared.world.scenario import Scenario
from simulator.records.decision import Decision
from simulator.records.summary import FlightFacts
from simulator.records.track import Track
from simulator.world.observation import StepTally


@dataclass
class Flight:
    """The whole steps of a mission that were flown.

    ``seed`` is ``None`` where the sensors are real. ``decisions`` are in order of step and UAV. ``tally`` has one entry
    a step. ``sensor_xy`` has shape (J, 2), metres. ``track`` has the true state before the first step and after each,
    as far as it is known.
    """

    scenario: Scenario
    seed: int | None
    decisions: list[Decision] = field(default_factory=list)
    tally: list[StepTally] = field(default_factory=list)
    sensor_xy: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    track: Track = field(default_factory=Track)
    interrupted: bool = False
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    duration_s: float = 0.0

    @property
    def steps_flown(self) -> int:
        """The number of whole steps flown."""
        return len(self.tally)

    def facts(self, **given: Any) -> FlightFacts:
        """The facts for ``simulator.records.summary.summarise``, and those given, which the flight does not know.

        The model and the deadline are those of its last decision that has one.
        """
        for name in ("model", "deadline_ms"):
            given[name] = next((known for d in reversed(self.decisions) if (known := getattr(d, name))), given[name])
        return FlightFacts(
            scenario=self.scenario.name,
            version=version("aic-vds"),
            **{name: getattr(self.scenario, name) for name in ("steps", "uavs", "sensors")},
            **{
                name: getattr(self, name) for name in ("seed", "steps_flown", "interrupted", "started_at", "duration_s")
            },
            **given,
        )


def exchange_fields(exchange: Exchange | None) -> dict[str, Any]:
    """The fields of a ``Decision`` that come from the edge's answer; empty without an exchange."""
    if exchange is None:
        return {}
    answer = exchange.response
    answered = ("model", "decision_id", "top_k", "tokens", "latency_ms", "deadline_ms")
    measured = ("rtt_ms", "attempts", "request_bytes", "response_bytes", "attention_bytes")
    fields = {name: getattr(answer, name) for name in answered} | {name: getattr(exchange, name) for name in measured}
    return fields | {"trust": {} if answer.guided is None else answer.guided.trust}
