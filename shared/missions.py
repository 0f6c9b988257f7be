"""The edge's answers about its missions: one mission's status, its attention weights, the list of all."""

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
    """``GET /missions/{id}``; ``experiences`` is their number, ``prompt.experiences`` the largest number."""

    mission_id: MissionId
    scenario: Scenario
    mode: Mode
    top_k: int
    attention: Literal["on", "off"] = "on"
    features: Features = "paper"
    belief: Belief = "fleet"
    verify: Literal["on", "off"] = "off"
    planner: Literal["on", "off"] = Field(
        "off", description="`on` if it is set, OR-Tools is installed, and the fleet is small enough"
    )
    prompt: PromptStyle = PromptStyle()
    init: Init
    seed: int
    note: str | None = Field(None, description="the operator's newest note")
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
    """``GET /missions/{id}/attention``: with the scenario, everything to score sensors as the mission does.

    ``weights`` are ``query``, ``key`` and ``value`` ``(d', d)``, ``score`` ``(1, d')`` and ``bias`` ``(1,)``, of d
    features of the preset; the scores are ``softmax(Q K^T / sqrt(d')) V w + b`` with ``Q = X W_q^T`` and so on.
    """

    mission_id: MissionId
    features: Features
    belief: Belief
    top_k: int = Field(description="sensors that the mission offers; without attention, all of them")
    updates: int = Field(description="outcomes that the weights have learned from since the mission began")
    weights: list[WeightArray]


class MissionLine(Wire):
    """One mission of the list. For a mission that is only in the store, only its ID is known."""

    mission_id: MissionId
    mode: Mode | None = None
    decisions: int | None = None


class MissionList(Wire):
    """``GET /missions``: at most 200 missions, the latest decision first; ``more`` further ones are not listed."""

    missions: list[MissionLine]
    more: int
    newest: MissionId | None = Field(description="the mission of the latest decision since the edge started")
    may_command: bool = Field(True, description="whether this request's key may make, guide and delete missions")


class DecisionPrompt(Wire):
    """``GET /missions/{id}/decisions/{decision_id}/prompt``, in the three blocks of the prompt.

    ``asked`` says whether an LLM got the prompt; otherwise the prompt only serves the token accounting.
    """

    decision_id: DecisionId
    asked: bool
    static: str
    experiences: str
    state: str
