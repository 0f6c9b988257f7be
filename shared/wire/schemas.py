"""The wire: the UAVs' requests to the edge and its answers, with all their bounds.

Columns are parallel arrays, one entry for each sensor. A sensor that a UAV has never heard has its
surveyed position (``x``, ``y``), and ``null`` in the four columns that only a beacon can fill.
"""

import operator
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from shared.wire.names import MapShapes, Names
from shared.wire.problem import INCOMPLETE
from shared.wire.reasons import Reason
from shared.wire.strict_models import Received, Wire, omitted, one_paragraph
from shared.world.scenario import MAX_SENSORS, Scenario

MAX_STEP = 1_000_000
# A UAV that waited longer reports this much.
MAX_ROUND_TRIP_MS, MAX_COST = 600_000.0, 10_000.0
# Characters of an operator's note, which is part of every long prompt.
MAX_NOTE = 280


MissionId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", examples=["default"])]
DecisionId = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", examples=["0123456789abcdef0123456789abcdef"])]
UavId = Annotated[int, Field(ge=0, le=99)]
Step = Annotated[int, Field(ge=0, le=MAX_STEP)]
SensorId = Annotated[int, Field(ge=0, lt=MAX_SENSORS)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Packets = Annotated[float, Field(ge=0, le=100_000)]
Joules = Annotated[float, Field(ge=0, le=1e9)]
Decibels = Annotated[float, Field(ge=-400, le=0)]
Note = Annotated[str, Field(max_length=MAX_NOTE), AfterValidator(one_paragraph)]
DeadlineMs = Annotated[int, Field(ge=10, le=60_000, description="answer within this many milliseconds")]

Mode = Literal["llm", "guided", "value", "policy"]
# The modes that ask an LLM.
LLM_MODES: tuple[Mode, ...] = ("llm", "guided")
Init = Literal["pretrained", "random"]
Features = Literal["paper", "reach"]
Belief = Literal["fleet", "reported"]
# Version 0.1.0 had two more, which ``failures`` replaces.
Selection = Annotated[
    Literal["recent", "failures"], BeforeValidator(lambda value: "failures" if value in ("similar", "best") else value)
]
Source = Literal["llm", "guided", "value", "policy"]
Uplink = Literal["full", "delta", "pruned"]


def _column(description: str) -> Any:
    return Field(max_length=MAX_SENSORS, fail_fast=True, description=description)


Surveyed = Annotated[list[Metres], _column("m, surveyed; omitted: as sent before")]


class SensorColumns(Received):
    """One UAV's knowledge of the sensors: parallel arrays of 1 to 2,000 entries, all of the same length.

    ``queue`` packets, ``battery`` joules, ``channel_gain`` dB and ``last_seen`` (the step of the last beacon) are all
    ``null`` for a sensor never heard, and all set for any other. ``x`` and ``y`` may both be omitted for sensors whose
    positions any UAV of the mission has sent. Only a report with a ``base`` may be empty.
    """

    id: Annotated[list[SensorId], _column("no duplicates")]
    x: Surveyed = Field(default_factory=list, exclude_if=operator.not_)
    y: Surveyed = Field(default_factory=list, exclude_if=operator.not_)
    queue: Annotated[list[Packets | None], _column("packets waiting")]
    battery: Annotated[list[Joules | None], _column("J left")]
    channel_gain: Annotated[list[Decibels | None], _column("dB, minus the path loss")]
    last_seen: Annotated[list[Step | None], _column("step of the last beacon")]

    @model_validator(mode="after")
    def _rectangular(self) -> Self:
        expected = len(self.id)
        placed = ("x", "y") if self.x or self.y else ()
        for name in (*placed, "queue", "battery", "channel_gain", "last_seen"):
            if len(getattr(self, name)) != expected:
                raise ValueError(f"column {name} has {len(getattr(self, name))} entries, column id has {expected}")
        if len(set(self.id)) != expected:
            seen: set[int] = set()
            twice = next(i for i in self.id if i in seen or seen.add(i))  # type: ignore[func-returns-value]
            raise ValueError(f"column id names sensor {twice} more than once")
        never = [value is None for value in self.queue]
        for column in (self.battery, self.channel_gain, self.last_seen):
            missing = [value is None for value in column]
            if missing != never:
                row = next(i for i, pair in enumerate(zip(missing, never, strict=True)) if pair[0] != pair[1])
                raise ValueError(
                    f"sensor {self.id[row]}: queue, battery, channel_gain and last_seen are all null or none is"
                )
        return self


class Outcome(Received):
    """The outcome of an earlier decision. It counts once, however often it is sent."""

    decision_id: DecisionId
    cost: float = Field(ge=0, le=MAX_COST, description="c, 0 is best; the value regression's target is -c")
    failed: bool = Field(False, description="the transmission failed (f = 1)")
    # Omitted if not set, so that a request repeated after an upgrade is still the same request.
    round_trip_ms: float | None = omitted(
        "from the request for that decision to its answer, measured by the UAV, retries included; the "
        "mission page shows it, and nothing learns from it",
        ge=0,
        le=MAX_ROUND_TRIP_MS,
    )


class UavState(Received):
    """One UAV at one waypoint."""

    uav_id: UavId
    position: list[Metres] = Field(min_length=2, max_length=2, description="x, y in m")
    progress_m: float | None = Field(
        None, ge=0, le=1e9, description="m along its trajectory, from its first waypoint (a circle's: due east)"
    )
    # All of these are omitted if not set, for the same reason as an outcome's round trip.
    battery_percent: float | None = omitted(
        "of the UAV's own battery; for the page and its alarm, nothing else uses it", ge=0, le=100
    )
    height_m: float | None = omitted("m above the take-off place, for the page only", ge=-1000, le=1e5)
    top_speed_mps: float | None = omitted(
        "the ground speed that it has not exceeded though it was commanded more: the edge decides on no "
        "higher velocity, to the nearest m/s and at least 1, where the orders allow that, until another is sent",
        gt=0,
        le=1000,
    )
    base: DecisionId | None = omitted(
        "this UAV's last decision in this mission: `sensors` then has only the rows that differ from the "
        "report which that decision answered, if any. 409 of type `" + INCOMPLETE + "` if the edge "
        "does not have that report (any more): send the whole report"
    )
    uplink: Literal["delta"] | None = omitted(
        "`delta`: the edge is to keep this report, so that the UAV's next report may name the decision as "
        "its `base`; a `base` implies `delta`"
    )
    sensors: SensorColumns
    outcome: Outcome | None = Field(None, description="of this UAV's previous decision")

    @field_validator("sensors", mode="after")
    @classmethod
    def _some_rows(cls, sensors: SensorColumns, info: ValidationInfo) -> SensorColumns:
        if not sensors.id and info.data.get("base") is None:
            raise ValueError("column id has no entries: a report without a base names at least one sensor")
        return sensors


class DecideRequest(UavState):
    """``POST /decide``: one UAV's report, answered by its next sensor and velocity."""

    mission_id: MissionId = "default"
    step: Step
    deadline_ms: DeadlineMs | None = None


class BatchRequest(Received):
    """``POST /decide/batch``: a fleet's UAVs at one step, decided in the given order."""

    mission_id: MissionId = "default"
    step: Step
    deadline_ms: DeadlineMs | None = Field(None, description="for the whole batch")
    uavs: list[UavState] = Field(min_length=1, max_length=100, fail_fast=True)

    @model_validator(mode="after")
    def _one_state_a_uav(self) -> Self:
        ids = [uav.uav_id for uav in self.uavs]
        if len(set(ids)) != len(ids):
            raise ValueError("uavs: a UAV appears more than once")
        return self


class Candidate(Wire):
    """A sensor that the attention module kept, with its score."""

    sensor_id: SensorId
    score: float
    llm: float | None = omitted("mode `llm` with the compact prompt: the probability of the letters that name it")


class Weighed(Wire):
    """A candidate of mode ``guided``. ``llm`` is the LLM's calibrated probability, ``null`` without an answer."""

    sensor_id: SensorId
    velocity: int = Field(ge=0, le=14)
    llm: float | None = None
    mixture: float = Field(description="the advisers' probabilities, weighted by trust")
    regret: float = Field(
        description="packets that it is expected to lose above the best candidate, by the rollout evaluator"
    )
    score: float = Field(description="ln(mixture) - 0.6 min(regret, 8): the UAV flies the highest")


class Guided(Wire):
    """A decision of mode ``guided``: the trust in each adviser, and the best candidates, best first."""

    trust: dict[str, float] = Field(description="weight of each adviser before this decision; they sum to 1")
    calibrated: bool = Field(description="whether the LLM's bias towards labels is removed")
    candidates: list[Weighed] = Field(max_length=5)


class Tokens(Wire):
    """Token accounting of one decision.

    The edge counts ``static``, ``experiences``, ``state`` and their sum ``prompt`` with ``tokenizer``.
    ``state_uncompressed`` is the state block with a full row for every reported sensor, ``uncompressed`` the whole
    prompt with that block, and ``saved`` the difference. ``completion``, ``cached`` and ``server_prompt`` come from
    the LLM server's ``usage``, in the model's own tokens, chat template included; ``null`` without one.
    """

    tokenizer: str
    static: int
    experiences: int
    state: int
    state_uncompressed: int
    prompt: int
    uncompressed: int
    saved: int
    completion: int | None = None
    cached: int | None = None
    server_prompt: int | None = None
    cost_usd: float | None = None


class DecideResponse(Wire):
    """The decision: collect from ``sensor_id``, fly the next step at ``velocity`` m/s."""

    decision_id: DecisionId
    mission_id: MissionId
    uav_id: UavId
    step: Step
    sensor_id: SensorId = Field(description="collect from this sensor, which the report may not name")
    velocity: int = Field(ge=0, le=14, description="m/s, for the next step")
    source: Source = Field(
        description="`llm`: the LLM's answer; `guided`: several advisers, the LLM among them; `value`: the learned "
        "modules; `policy`: the planner or one step of look-ahead"
    )
    reason: Reason | None = Field(None, description="why the decision is not the LLM's")
    model: str | None = None
    top_k: list[Candidate]
    guided: Guided | None = Field(None, description="in mode `guided` only")
    tokens: Tokens
    deadline_ms: int = Field(description="the time limit of this decision, once its request is read and checked")
    latency_ms: dict[str, float] = Field(description="by stage, and total")
    stored: bool = Field(
        True,
        description="whether the decision, and the outcome in the request, are on disk: if not, send the "
        "outcome again by `/feedback`. Always true for an edge without a store",
    )


class BatchResponse(Wire):
    """One decision for each UAV, in the order of the request."""

    decisions: list[DecideResponse]


class FeedbackRequest(Outcome):
    """``POST /feedback``: an outcome on its own."""

    mission_id: MissionId | None = Field(
        None, description="the decision's mission; omitted: the mission in memory that knows the decision"
    )


class FeedbackResponse(Wire):
    """``applied`` the first time, ``duplicate`` every further time."""

    decision_id: DecisionId
    result: Literal["applied", "duplicate"]


PromptFormat = Literal["csv", "compact"]


class PromptStyle(Received):
    """The form of the prompt.

    ``shuffled`` draws a new order of the rows for every step and UAV, from the mission's seed. Experiences are appended
    until there are too many; ``selection`` then chooses the ones that stay.
    """

    format: PromptFormat | None = Field(
        None,
        description="`compact` is one digit a number, for an LLM with the adapter of `python -m lab distill`; default: "
        "`compact` where the edge's LLM has one, else `csv`",
    )
    order: Literal["score", "shuffled"] = Field("score", description="of the rows; `score`: best first")
    experiences: int | None = Field(
        None, ge=0, le=100, description="number before half of them are dropped; default: the service's"
    )
    selection: Selection | None = Field(
        None,
        description="experiences that stay: the newest, or the newest of each sensor with failures first; default: "
        "the service's, and `failures` with the compact prompt",
    )
    # Specs of stored missions name it.
    demonstrations: int = Field(0, ge=0, le=0, deprecated=True, description="0: no prompt has worked examples any more")


class MissionSpec(Received):
    """``PUT /missions/{id}``: the world that a fleet flies in and how it decides.

    ``attention`` off is the paper's baseline: the prompt has every admissible sensor, in the request's order. Mode
    ``value`` always uses attention.
    """

    scenario: Annotated[str, Field(max_length=32)] | Scenario = Field(
        "paper", description="a preset's name or a whole scenario"
    )
    mode: Mode | None = Field(None, description="default: the service's")
    top_k: int | None = Field(None, ge=1, le=100, description="default: the service's")
    attention: Literal["on", "off"] = Field(
        "on", description="`off`: no pruning, the prompt has every admissible sensor"
    )
    features: Features | None = Field(
        None,
        description="the modules' inputs: `paper`, its five numbers a sensor, or `reach`, with seven more on packets "
        "in reach along the trajectory; default: `paper` in mode `llm`, else `reach`",
    )
    belief: Belief | None = Field(
        None,
        description="the basis of decisions: `fleet`, the newest report of any UAV, rolled forward, or `reported`, the "
        "UAV's own last beacons; default: `reported` in mode `llm`, the paper's method, else `fleet`",
    )
    planner: Literal["on", "off"] | None = Field(
        None, description="`off`: one step of look-ahead is the LLM-free policy; default: the service's"
    )
    verify: Literal["on", "off"] | None = Field(
        None,
        description="mode `llm`: whether the policy overrides an answer that breaks a hard rule (out of reach, flat "
        "battery); default: the service's",
    )
    prompt: PromptStyle = PromptStyle()
    init: Init = Field("pretrained", description="the modules' initial weights; `random` as the paper suggests")
    seed: int = Field(0, ge=0, lt=2**32, description="of random initial weights and of shuffled rows")
    note: Note | None = Field(
        None,
        description="the operator's note in plain words, such as `suspected leak at sensor 4: visit it every third "
        "step`",
    )
    names: Names | None = omitted("the user's names of sensors and UAVs: on the page, and for notes")
    map: MapShapes | None = omitted("lines and areas behind the page's map; notes may use their names")


class Readiness(Wire):
    """``GET /readyz``: whether the edge can decide, and its present mode."""

    ready: bool
    decides: Source
    llm: Literal["loading", "ready", "degraded", "unavailable", "off"] = Field(
        description="degraded: its answers cannot be used"
    )
    model: str | None = None
    standing_by: int = Field(0, description="further healthy LLM servers")
    constraint: str | None = Field(None, description="how the server constrains the LLM to the answer's form")
    abilities: str | None = Field(None, description="what the LLM server can do, and the requests that it demands")
    decision_ms: float | None = Field(None, description="duration of the decision by which the server was last probed")
    detail: str | None = None
