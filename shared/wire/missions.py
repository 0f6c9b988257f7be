"""The edge's answers about its missions: one mission's status, its attention weights, the list of all."""

from typing import Literal

from pydantic import Field

from shared.wire.names import Names
from shared.wire.schemas import Belief, DecisionId, Features, Init, MissionId, Mode, PromptStyle
from shared.wire.strict_models import Wire, omitted
from shared.world.scenario import Scenario


class LearnedWorld(Wire):
    """A fleet's learned differences of its world from the scenario's formulas."""

    offset_db: float = Field(description="excess of the path loss over the formula's that all links share, dB")
    deviation_db: float = Field(description="standard deviation of the excess loss of a link never measured, dB")
    rate_share: float = Field(description="the rate that transfers get, as a share of the formula's")
    wind: list[float] = Field(
        min_length=2, max_length=2, description="east and north, as a share of the way that the velocity commands"
    )
    dispersion: float = Field(description="the variance of arrivals over a Poisson's, at least 1; 1: no bursts")
    failed_radios: list[int] = Field(description="sensors whose transmissions fail over good links")
    excess_db: dict[int, float] = Field(
        description="sensor: mean of its latest measured excess losses, dB, where that is more than 1 dB off"
    )


class VisitDeadline(Wire):
    """The deadlines of one order to visit a sensor at least once in any ``visit_every`` steps.

    A deadline ends in each step whose last ``visit_every`` steps were flown under the order, and is met if the sensor
    was visited in one of them. Only completed steps count. A visit counts until its outcome says that it failed.
    """

    sensor_id: int
    visit_every: int
    since: int = Field(description="the first step under the order")
    until: int | None = Field(description="the first step no longer under it; null while it is in force")
    met: int
    missed: int


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
    planner: Literal["on", "off"] = Field("off", description="`on` if it is set and the fleet is small enough")
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
    # Omitted where there is none: an older client refuses fields that it does not know.
    learned: LearnedWorld | None = omitted(
        "how the world differs from the scenario's formulas; omitted without evidence that it does"
    )
    deadlines: list[VisitDeadline] | None = omitted(
        "the orders to visit sensors, ended ones first, at most 100 of these; omitted where none was given"
    )
    readings: int | None = omitted("sensors' own readings that changed the belief; omitted where there was none")
    alarms: dict[str, dict[int, int | None]] | None = omitted(
        "in `GET`: `uav_lost`, `uav_off_path`, `uav_battery`, `visit_late` or `sensor_battery`, each with "
        "the UAVs' or sensors' IDs and the step since when, null if unknown; omitted without an alarm"
    )
    names: Names | None = omitted("the user's names of sensors and UAVs; omitted where none were given")


class WeightArray(Wire):
    """One array of a module's weights: ``values`` row by row, float32."""

    name: str
    shape: list[int]
    values: list[float]


class MissionAttention(Wire):
    """``GET /missions/{id}/attention``: with the scenario, all that scores need (:mod:`shared.features`).

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
    in_words: list[str] = Field([], description="what the digits of a compact prompt's `state` say, a line a row")
