"""Worlds that the wire accepts and few would fly in: every mode decides in them, and the page can draw them."""

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

NOBODY = "http://127.0.0.1:9/v1"
WORLDS = {
    "nothing arrives": {"arrival_rate_min": 0.0, "arrival_rate_max": 0.0},
    "next to nothing arrives": {"arrival_rate_min": 0.0, "arrival_rate_max": 5e-324},
    "nothing gets through": {"noise_dbm_hz": 0.0, "bandwidth_hz": 1e12},
}


@pytest.mark.parametrize("world", list(WORLDS))
@pytest.mark.parametrize("mode", ["guided", "value", "policy"])
def test_an_odd_world_is_flown_in(edge: Edge, report: Report, mode: str, world: str) -> None:
    client = edge(mode=mode, llm_url=NOBODY)
    spec = {"scenario": {"name": "odd", **WORLDS[world]}}
    assert client.put("/missions/test", json=spec).status_code == 200
    for step in range(3):
        answer = client.post("/decide", json=report(step=step))
        assert answer.status_code == 200, answer.text
    with client.stream("GET", "/missions/test/events") as events:
        line = next(line for line in events.iter_lines() if line.startswith("data:"))
    shown = json.loads(line.removeprefix("data:"))
    assert None not in shown["urgency"] and None not in shown["queue"]


def test_a_report_from_the_future_does_not_blind_a_mission(edge: Edge, report: Report) -> None:
    client = edge()
    # An edge that lost its missions hears of them in their midst.
    assert client.post("/decide", json=report(step=5000)).status_code == 200
    forged = client.post("/decide", json=report(step=1_000_000, uav_id=2))
    assert forged.status_code == 422
    [error] = forged.json()["errors"]
    assert error["field"] == "step" and "5000, the newest step known" in forged.json()["detail"] + str(error)
    honest = report(step=5001)
    honest["sensors"]["queue"][:4] = [59.0] * 4
    assert client.post("/decide", json=honest).status_code == 200
    with client.stream("GET", "/missions/test/events") as events:
        line = next(line for line in events.iter_lines() if line.startswith("data:"))
    shown = json.loads(line.removeprefix("data:"))
    assert shown["step"] == 5001 and shown["queue"][:4] == [59.0] * 4


def test_a_fleet_that_begins_again_in_the_same_mission_is_reported(
    edge: Edge, report: Report, caplog: pytest.LogCaptureFixture
) -> None:
    client = edge()
    for step, uav in ((0, 0), (3, 0), (0, 1), (4, 0)):
        assert client.post("/decide", json=report(step=step, uav_id=uav)).status_code == 200
    assert "DELETE" not in caplog.text
    assert client.post("/decide", json=report(step=0)).status_code == 200
    assert "mission test: step 0 after step 4: to fly it again, DELETE it first" in caplog.text
    caplog.clear()
    client.delete("/missions/test").raise_for_status()
    assert client.post("/decide", json=report(step=0)).status_code == 200
    assert "DELETE" not in caplog.text


@pytest.mark.parametrize(("steps", "away"), [(30, 64), (500, 500)])
def test_a_fleet_that_was_out_of_contact_comes_back(edge: Edge, report: Report, steps: int, away: int) -> None:
    client = edge()
    client.put("/missions/test", json={"scenario": {"name": "long", "steps": steps}})
    assert client.post("/decide", json=report(step=0)).status_code == 200
    assert client.post("/decide", json=report(step=away, uav_id=1)).status_code == 200
    one = {key: report(step=2 * away + 1)[key] for key in ("position", "sensors")}
    batch = {"mission_id": "test", "step": 2 * away + 1, "uavs": [{"uav_id": uav, **one} for uav in range(3)]}
    assert client.post("/decide/batch", json=batch).status_code == 422
    assert client.get("/missions/test").json()["decisions"] == 2
    assert client.delete("/missions/test").status_code == 204
    assert client.post("/decide/batch", json=batch).status_code == 200
