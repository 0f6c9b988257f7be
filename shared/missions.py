"""What the edge tells of its missions: where one stands, what it learned, which there are."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from shared.scenario import Scenario
from shared.wire import (
    Belief,
    DecisionId,
    Features,
    Init,
    MissionId,
    Mode,
    PromptStyle,
    Wire,
)


class MissionStatus(Wire):
    """``GET /missions/{id}``; ``experiences`` is how many there are, ``prompt.experiences`` how many there can be."""

    mission_id: MissionId
    scenario: Scenario
    mode: Mode
    top_k: int
    attention: Literal["on", "off"] = "on"
    features: Features = "paper"
    belief: Belief = "fleet"
    verify: Literal["on", "off"] = "off"
    planner: Literal["on", "off"] = Field("off", description="`on` where it is wanted, installed, and up to the size")
    prompt: PromptStyle = PromptStyle()
    init: Init
    seed: int
    decisions: int
    feedback: int
    experiences: int
    learner_updates: int
    learner_loss: float | None
    visits: dict[int, int] = Field(description="sensor: step of the last visit")


class WeightArray(Wire):
    """One array of a module's weights: ``values`` row by row, float32."""

    name: str
    shape: list[int]
    values: list[float]


class MissionAttention(Wire):
    """``GET /missions/{id}/attention``: what a UAV needs, beside the scenario, to score sensors as the mission does.

    ``weights`` are ``query``, ``key`` and ``value`` ``(d', d)``, ``score`` ``(1, d')`` and ``bias`` ``(1,)``, of d
    features of the preset; the scores are ``softmax(Q K^T / sqrt(d')) V w + b`` with ``Q = X W_q^T`` and so on.
    """

    mission_id: MissionId
    features: Features
    belief: Belief
    top_k: int = Field(description="sensors that the mission offers: all of them where it goes without attention")
    updates: int = Field(description="outcomes that the weights were learned from, since the mission began")
    weights: list[WeightArray]


class MissionLine(Wire):
    """One mission of the list. Of one that is only in the store, no more than its name is known."""

    mission_id: MissionId
    mode: Mode | None = None
    decisions: int | None = None


class MissionList(Wire):
    """``GET /missions``: at most 200, the one that decided last first; ``more`` are not listed."""

    missions: list[MissionLine]
    more: int
    newest: MissionId | None = Field(description="the one that decided last, since the edge started")


class DecisionPrompt(Wire):
    """``GET /missions/{id}/decisions/{decision_id}/prompt``, in the three blocks of the prompt.

    ``asked`` says whether an LLM was asked by it; where none is, the prompt is made for the token accounting alone.
    """

    decision_id: DecisionId
    asked: bool
    static: str
    experiences: str
    state: str
