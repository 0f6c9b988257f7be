"""Hard rules: what breaks one is flown by nobody, and what keeps them all is left alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi.responses import Response

from service.deciding.attended_state import AttendedState
from service.deciding.modes import verify
from service.llm.answers import NoDecision
from service.mission.mission import Mission
from service.prompting.compact_prompt import sign
from shared.wire.schemas import MissionSpec
from shared.world.step_rule import Action
from tests.support.missions import attended, mission, uav
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, chat_completion, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def ready(**spec: Any) -> tuple[Mission, AttendedState]:
    """A UAV over the centre, off its trajectory, with sensors 0 to 500 m away: 4 and 5 are out of reach."""
    m = mission(MissionSpec(**spec))
    state = uav()
    m.observe(state, 0)
    return m, attended(m, state)


@pytest.mark.parametrize(("sensor", "velocity"), [(0, 0), (3, 14), (1, 7)])
def test_what_is_in_reach_is_left_alone(sensor: int, velocity: int) -> None:
    _m, view = ready()
    verify(view, Action(sensor, velocity))


def test_out_of_reach_breaks_a_rule_unless_everything_is() -> None:
    _m, view = ready()
    with pytest.raises(NoDecision) as broken:
        verify(view, Action(5, 14))
    assert broken.value.reason == "rule_reach"
    lonely = mission()
    far = uav(x=[5000.0, 6000.0], queue=[10.0, 20.0])
    lonely.observe(far, 0)
    verify(attended(lonely, far), Action(1, 7))


def test_a_battery_that_another_uav_found_flat_breaks_a_rule() -> None:
    m, view = ready()
    m.belief.battery[2] = 0.0
    with pytest.raises(NoDecision) as broken:
        verify(view, Action(2, 7))
    assert broken.value.reason == "rule_battery"


def test_without_the_verifier_only_a_reservation_counts() -> None:
    m, view = ready(verify="off")
    m.belief.battery[2] = 0.0
    verify(view, Action(2, 7))
    verify(view, Action(5, 14))
    other = attended(m, uav(uav_id=1))
    m.commit(other.pending("a" * 32, Action(2, 7)))
    with pytest.raises(NoDecision) as broken:
        verify(view, Action(2, 7))
    assert broken.value.reason == "answer_reserved"


@pytest.mark.parametrize(("verified", "source", "reason"), [("on", "policy", "rule_reach"), ("off", "llm", None)])
def test_an_llm_that_names_what_is_out_of_reach_is_overridden_and_counted(
    edge: Edge, report: Report, verified: str, source: str, reason: str | None
) -> None:
    with serving(StubLlm(answer="2 0").app) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", verify=verified)
        wait_for(client, "ready")
        body = report()
        body["sensors"]["x"][2], body["sensors"]["y"][2] = 10.0, 990.0
        answer = client.post("/decide", json=body).json()
        assert (answer["source"], answer["reason"]) == (source, reason)
        assert (answer["sensor_id"] == 2) == (verified == "off")
        assert client.get("/missions/test").json()["verify"] == verified
        assert (
            f'aicvds_decisions_total{{reason="{reason or "none"}",source="{source}"}} 1.0'
            in client.get("/metrics").text
        )


class Namer(StubLlm):
    """Answers the first letter of a sensor's row in the compact prompt."""

    def __init__(self, sensor: int) -> None:
        super().__init__("A")
        self.sensor = sensor

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        row = re.search(rf"\d{sign(self.sensor)}\d{{7}}([A-T])", body["messages"][-1]["content"])
        return chat_completion(self.answer if row is None else row[1])


@pytest.mark.parametrize(
    ("sensor", "verified", "source", "reason"),
    [(2, "on", "policy", "rule_reach"), (2, "off", "llm", None), (1, "on", "llm", None)],
)
def test_a_letter_of_a_sensor_out_of_reach_is_overridden_too(
    edge: Edge, report: Report, sensor: int, verified: str, source: str, reason: str | None
) -> None:
    with serving(Namer(sensor).app) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", llm_adapter="served", verify=verified)
        wait_for(client, "ready")
        assert client.put("/missions/test", json={}).json()["prompt"]["format"] == "compact"
        body = report()
        body["sensors"]["x"][2], body["sensors"]["y"][2] = 10.0, 990.0
        answer = client.post("/decide", json=body).json()
        assert (answer["source"], answer["reason"]) == (source, reason)
        assert (answer["sensor_id"] == sensor) == (source == "llm")
