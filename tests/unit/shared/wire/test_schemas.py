"""The wire: what is taken, and what is refused with the field at fault named."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from shared.wire.schemas import (
    BatchRequest,
    DecideRequest,
    FeedbackRequest,
    MissionSpec,
    Outcome,
    PromptStyle,
    SensorColumns,
)
from shared.world.scenario import SCENARIOS

DECISION = "0123456789abcdef0123456789abcdef"


def columns(**changes: Any) -> dict[str, Any]:
    """Two sensors heard and one never heard."""
    return {
        "id": [0, 1, 2],
        "x": [10.0, 20.0, 30.0],
        "y": [1.0, 2.0, 3.0],
        "queue": [5.0, 60.0, None],
        "battery": [50.0, 49.5, None],
        "channel_gain": [-80.0, -101.5, None],
        "last_seen": [4, 3, None],
        **changes,
    }


def body(**changes: Any) -> dict[str, Any]:
    return {"uav_id": 0, "step": 4, "position": [500.0, 500.0], "sensors": columns(), **changes}


def refusal(payload: dict[str, Any]) -> str:
    """What a request's refusal says, read as JSON as the service reads it."""
    with pytest.raises(ValidationError) as caught:
        DecideRequest.model_validate_json(json.dumps(payload))
    return str(caught.value)


def test_a_good_request_is_taken_and_survives_json() -> None:
    request = DecideRequest.model_validate_json(json.dumps(body(outcome={"decision_id": DECISION, "cost": 0.5})))
    assert request.mission_id == "default"
    assert request.sensors.last_seen == [4, 3, None]
    assert DecideRequest.model_validate_json(request.model_dump_json()) == request


@pytest.mark.parametrize("name", ["x", "y", "queue", "battery", "channel_gain", "last_seen"])
def test_a_ragged_column_is_named(name: str) -> None:
    short = columns()[name][:2]
    assert f"column {name} has 2 entries, column id has 3" in refusal(body(sensors=columns(**{name: short})))


def test_a_duplicate_sensor_is_named() -> None:
    assert "column id names sensor 1 more than once" in refusal(body(sensors=columns(id=[0, 1, 1])))


@pytest.mark.parametrize("name", ["queue", "battery", "channel_gain", "last_seen"])
def test_nulls_come_all_together_or_not_at_all(name: str) -> None:
    partly = columns()[name][:]
    partly[0] = None
    assert "sensor 0: queue, battery, channel_gain and last_seen" in refusal(body(sensors=columns(**{name: partly})))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["x", "queue", "battery", "channel_gain"])
def test_numbers_that_are_none(name: str, value: float) -> None:
    column = columns()[name][:]
    column[1] = value
    assert f"sensors.{name}.1" in refusal(body(sensors=columns(**{name: column})))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"position": [float("nan"), 0.0]}, "position.0"),
        ({"position": [1.0]}, "position"),
        ({"position": [1.0, 2.0, 3.0]}, "position"),
        ({"position": [2e6, 0.0]}, "position.0"),
        ({"uav_id": 100}, "uav_id"),
        ({"uav_id": "0"}, "uav_id"),
        ({"uav_id": True}, "uav_id"),
        ({"step": -1}, "step"),
        ({"step": 4.5}, "step"),
        ({"mission_id": "../etc"}, "mission_id"),
        ({"mission_id": ""}, "mission_id"),
        ({"deadline_ms": 9}, "deadline_ms"),
        ({"speed": 3}, "speed"),
        ({"sensors": columns(colour=[1, 2, 3])}, "sensors.colour"),
        ({"sensors": columns(id=["0", 1, 2])}, "sensors.id.0"),
        ({"sensors": columns(id=[-1, 1, 2])}, "sensors.id.0"),
        ({"sensors": columns(queue=[-1.0, 1.0, None])}, "sensors.queue.0"),
        ({"sensors": columns(queue=["5", 1.0, None])}, "sensors.queue.0"),
        ({"sensors": columns(channel_gain=[1.0, -80.0, None])}, "sensors.channel_gain.0"),
        ({"sensors": columns(x=[None, 1.0, 2.0])}, "sensors.x.0"),
        ({"sensors": {name: [] for name in columns()}}, "sensors"),
        ({"base": "abc"}, "base"),
        ({"uplink": "pruned"}, "uplink"),
        ({"outcome": {"decision_id": "abc", "cost": 0.0}}, "outcome.decision_id"),
        ({"outcome": {"decision_id": DECISION, "cost": -0.1}}, "outcome.cost"),
        ({"outcome": {"decision_id": DECISION, "cost": 0.0, "failed": 1}}, "outcome.failed"),
    ],
)
def test_a_field_out_of_form_is_named(change: dict[str, Any], field: str) -> None:
    assert f"\n{field}\n" in refusal(body(**change))


def test_what_need_not_be_told_is_left_out() -> None:
    reported = columns()
    del reported["x"], reported["y"]
    request = DecideRequest.model_validate_json(json.dumps(body(sensors=reported, base=DECISION)))
    again = request.model_dump_json()
    assert DecideRequest.model_validate_json(again) == request and '"x"' not in again
    assert not {"base", "uplink"} & DecideRequest.model_validate(body()).model_dump().keys()
    assert "column y has 0 entries, column id has 3" in refusal(body(sensors=columns(y=[])))
    nobody: dict[str, Any] = {key: [] for key in reported}
    assert "column id has no entries" in refusal(body(sensors=nobody))
    assert DecideRequest.model_validate_json(json.dumps(body(sensors=nobody, base=DECISION))).sensors.id == []


def test_a_missing_field_is_named() -> None:
    short = body()
    del short["sensors"]["battery"]
    assert "\nsensors.battery\n  Field required" in refusal(short)


def test_a_batch_names_each_uav_once() -> None:
    state = {key: value for key, value in body().items() if key != "step"}
    other = {**state, "uav_id": 1}
    assert [u.uav_id for u in BatchRequest.model_validate({"step": 4, "uavs": [state, other]}).uavs] == [0, 1]
    with pytest.raises(ValidationError, match="a UAV appears more than once"):
        BatchRequest.model_validate({"step": 4, "uavs": [state, state]})


def test_feedback_is_an_outcome_with_a_mission() -> None:
    feedback = FeedbackRequest.model_validate({"decision_id": DECISION, "cost": 1.0})
    assert isinstance(feedback, Outcome)
    assert feedback.mission_id is None


def test_a_mission_takes_a_presets_name_or_a_whole_scenario() -> None:
    assert MissionSpec.model_validate({"scenario": "stress"}).scenario == "stress"
    whole = SCENARIOS["stress"].model_dump_json()
    assert MissionSpec.model_validate_json(f'{{"scenario": {whole}}}').scenario == SCENARIOS["stress"]


def test_a_mission_is_the_papers_unless_told_otherwise() -> None:
    spec = MissionSpec()
    assert (spec.attention, spec.features, spec.belief) == ("on", None, None)
    assert spec.prompt == PromptStyle(format=None, order="score", experiences=None)


def test_a_mission_with_its_own_prompt_survives_json() -> None:
    style = PromptStyle(format="compact", order="shuffled", experiences=30)
    spec = MissionSpec(attention="off", features="reach", prompt=style)
    assert MissionSpec.model_validate_json(spec.model_dump_json()) == spec


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"attention": "maybe"}, "attention"),
        ({"features": "all"}, "features"),
        ({"prompt": {"format": "xml"}}, "prompt.format"),
        ({"prompt": {"order": "random"}}, "prompt.order"),
        ({"prompt": {"experiences": 101}}, "prompt.experiences"),
        ({"prompt": {"experiences": -1}}, "prompt.experiences"),
        ({"prompt": {"experiences": True}}, "prompt.experiences"),
        ({"prompt": {"rows": 3}}, "prompt.rows"),
    ],
)
def test_a_mission_that_is_none_is_refused_by_field(change: dict[str, Any], field: str) -> None:
    with pytest.raises(ValidationError) as caught:
        MissionSpec.model_validate_json(json.dumps(change))
    assert field in str(caught.value)


def test_numpys_arrays_and_numbers_are_taken() -> None:
    sensors = SensorColumns(
        id=np.arange(2),  # type: ignore[arg-type]
        x=np.array([1.0, 2.0]),  # type: ignore[arg-type]
        y=[np.float64(3.0), np.float32(4.0)],  # type: ignore[list-item]
        queue=[None, np.float64(6.0)],
        battery=[None, 8.0],
        channel_gain=[None, -90.0],
        last_seen=[None, np.int64(0)],  # type: ignore[list-item]
    )
    assert (sensors.id, sensors.x, sensors.y) == ([0, 1], [1.0, 2.0], [3.0, 4.0])
    request = DecideRequest(step=np.int64(3), uav_id=0, position=np.array([1.0, 2.0]), sensors=sensors)  # type: ignore[arg-type]
    assert type(request.step) is int and request.position == [1.0, 2.0]
    with pytest.raises(ValidationError):
        DecideRequest(step=np.float64(3.0), uav_id=0, position=[1.0, 2.0], sensors=sensors)  # type: ignore[arg-type]
