"""``POST /missions/{id}/readings`` over HTTP: answers, refusals, keys, metrics, and what survives a power failure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.api_keys import KeyFile
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeRefused
from shared.wire.readings import ReadingsRequest, SensorReading
from tests.support.stored_missions import copy_of, fly, running, same, state, wait_for_updates

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
PATH = "/missions/test/readings"


def one(**more: Any) -> dict[str, Any]:
    return {"readings": [{"sensor_id": 4, "queue": 33, "step": 0, **more}]}


def test_readings_are_answered_each_and_counted(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={})
    early = client.post(PATH, json=one(message_id="m1"))
    assert (early.status_code, early.json()) == (200, {"results": ["early"], "step": None})
    client.post("/decide", json=report())
    answers = [client.post(PATH, json=one(message_id=name)).json() for name in ("m1", "m1", "m2")]
    assert [answer["results"] for answer in answers] == [["merged"], ["duplicate"], ["outdated"]]
    assert client.get("/missions/test").json()["readings"] == 1
    reported = client.get("/metrics").text
    for result in ("early", "merged", "duplicate", "outdated"):
        assert f'aicvds_readings_total{{result="{result}"}} 1.0' in reported


def test_a_decision_reckons_with_what_a_sensor_said_of_itself(edge: Edge, report: Report) -> None:
    """Of two sensors at the same place, never heard, the fuller one is worth more."""
    chosen = []
    for full in (3, 4):
        body = report(mission_id=f"full-{full}", position=[700.0, 500.0])
        sensors = body["sensors"]
        sensors["x"][3] = sensors["x"][4] = 720.0
        sensors["y"][3] = sensors["y"][4] = 510.0
        for column in ("queue", "battery", "channel_gain", "last_seen"):
            sensors[column] = [None] * 5
        client = edge()
        client.post("/decide", json=body)
        readings = [{"sensor_id": s, "queue": 60 if s == full else 0, "step": 0} for s in range(5)]
        answer = client.post(f"/missions/full-{full}/readings", json={"readings": readings})
        assert answer.json()["results"] == ["merged"] * 5
        chosen.append(client.post("/decide", json=body | {"step": 1}).json()["sensor_id"])
    assert chosen == [3, 4]


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "readings"),
        ({"readings": []}, "readings"),
        ({"readings": [{"sensor_id": 4, "queue": 3}]}, "readings[0]"),
        (one(age_s=3), "readings[0]"),
        (one(queue=-1), "readings[0].queue"),
        (one(queue=61), "readings[0].queue"),
        (one(sensor_id=10), "readings[0].sensor_id"),
        (one(step=1), "readings[0].step"),
        (one(step=None, age_s=90_000), "readings[0].age_s"),
        (one(battery=-1), "readings[0].battery"),
        (one(message_id=""), "readings[0].message_id"),
        (one(rssi=-90), "readings[0].rssi"),
        ({"readings": one()["readings"] * 2}, "body"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_recorded(edge: Edge, report: Report, body: Any, field: str) -> None:
    client = edge()
    client.post("/decide", json=report())
    refused = client.post(PATH, json=body)
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["field"] == field
    assert "readings" not in client.get("/missions/test").json()


def test_readings_make_no_mission(edge: Edge) -> None:
    client = edge()
    assert client.post(PATH, json=one()).status_code == 404
    assert client.get("/missions/test").status_code == 404


def test_a_key_for_readings_does_nothing_else(edge: Edge, report: Report, tmp_path: Path) -> None:
    file = KeyFile()
    sensors = file.add("sensors", frozenset({"readings"}), 1000)
    fleet = file.add("fleet", frozenset({"decide", "admin"}), 1000)
    file.write(tmp_path / "keys.json")
    client = edge(keys=tmp_path / "keys.json")
    as_sensors, as_fleet = ({"Authorization": f"Bearer {key}"} for key in (sensors, fleet))
    assert client.post("/decide", json=report(), headers=as_fleet).status_code == 200
    refused = client.post(PATH, json=one(), headers=as_fleet)
    assert refused.status_code == 403 and "lacks the scope readings" in refused.json()["detail"]
    assert client.post("/decide", json=report(), headers=as_sensors).status_code == 403
    assert client.delete("/missions/test", headers=as_sensors).status_code == 403
    assert client.post(PATH, json=one(), headers=as_sensors).json()["results"] == ["merged"]


def test_the_client_reports_readings(edge: Edge, report: Report) -> None:
    http = edge()
    http.post("/decide", json=report())
    given = ReadingsRequest(readings=[SensorReading(sensor_id=4, queue=3.0, age_s=1.0)])
    with EdgeClient(str(http.base_url)) as client:
        answer = client.send_readings("test", given)
        assert (answer.results, answer.step) == (["outdated"], 0) or answer.results == ["merged"]
        with pytest.raises(EdgeRefused) as refused:
            client.send_readings("nobody", given)
    assert refused.value.status == 404


def test_acknowledged_readings_survive_a_power_failure(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "m.db"
    with running(path) as (client, engine):
        pending = fly(client, report, range(3))
        given = {"readings": [{"sensor_id": 7, "queue": 9, "age_s": 3600.5, "message_id": "x"}]}
        assert client.post(PATH, json=given).json()["results"] == ["merged"]
        assert client.post(PATH, json=one(sensor_id=8, step=2, message_id="y")).json()["results"] == ["merged"]
        fly(client, report, range(3, 4), pending)
        mission = wait_for_updates(engine, engine.missions.loaded[0], 9)
        on_disk, before = copy_of(path, tmp_path / "copy.db"), state(mission)
    with running(on_disk) as (client, engine):
        assert client.get("/missions/test").json()["readings"] == 2
        assert same(state(engine.missions.loaded[0]), before)
        again = client.post(PATH, json=one(sensor_id=8, step=2, message_id="y"))
        assert again.json()["results"] == ["duplicate"]


def test_readings_that_are_sent_again_are_acknowledged_no_sooner_than_they_are_on_disk(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def not_yet(_timeout_s: float) -> bool:
        return False

    with running(tmp_path / "m.db") as (client, engine):
        fly(client, report, range(1))
        with monkeypatch.context() as slow:
            slow.setattr(engine.journal, "stored", not_yet)
            assert [client.post(PATH, json=one(message_id="x")).status_code for _ in range(2)] == [503, 503]
        again = client.post(PATH, json=one(message_id="x"))
        assert (again.status_code, again.json()["results"]) == (200, ["duplicate"])
