"""The snapshot that a page begins with: ages of its own time, due visits, and each UAV's newest report."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.integration.service.live.test_broadcaster import Edge, Report, decided, watching
from tests.support.running import serving
from tests.support.stored_missions import copy_of, fly, running, wait_until_written
from tests.support.stub_llm import StubLlm, wait_for
from tests.support.waiting import Clock


def test_a_later_listener_gets_the_ages_of_his_own_time(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    for module in ("broadcaster", "fleet_watch", "snapshots"):
        monkeypatch.setattr(f"service.live.{module}.time", clock)
    client = edge()
    decided(client, report())
    with watching(client) as early:
        assert next(early)[1]["idle_s"] < 3600.0
        clock.ahead_s = 3600.0
        with watching(client) as late:
            reported = next(late)[1]
    assert reported["idle_s"] >= 3600.0 and reported["uavs"]["0"]["heard_s"] >= 3600.0


def test_a_sensors_own_reading_reaches_an_open_page(edge: Edge, report: Report) -> None:
    client = edge()
    decided(client, report())
    with watching(client) as events:
        assert next(events)[1]["queue"][4] != 60.0
        readings = {"readings": [{"sensor_id": 4, "queue": 60, "step": 0}]}
        assert client.post("/missions/test/readings", json=readings).json()["results"] == ["merged"]
        assert next(events)[1]["queue"][4] == 60.0


def test_a_corrected_survey_moves_the_sensor_on_open_pages(edge: Edge, report: Report) -> None:
    client = edge()
    decided(client, report())
    with watching(client) as events:
        assert next(events)[1]["places"][0] == [420.0, 380.0]
        moved = report(step=1)
        moved["sensors"]["x"][0] = 100.0
        decided(client, moved)
        name, whole = next(events)
        assert name == "snapshot" and whole["places"][0] == [100.0, 380.0]


def test_a_uav_that_is_late_is_shown_where_it_is_believed_to_be(edge: Edge, report: Report) -> None:
    client = edge()
    for step in range(3):
        decided(client, report(step=step))
        if step < 2:
            decided(client, report(step=step, uav_id=1))
    with watching(client) as events:
        reported = next(events)[1]["uavs"]
    assert [(reported[uav]["step"], reported[uav]["position_step"]) for uav in "01"] == [(2, 2), (1, 2)]


def test_a_new_visit_order_is_due_by_its_own_first_step_and_a_late_uav_shows_its_report(
    edge: Edge, report: Report
) -> None:
    client = edge()
    for step in range(6):
        for number in (0, 1):
            if (step, number) != (5, 1):
                decided(client, report(step=step, uav_id=number))
    order = {"guidance": {"sensors": [{"sensor_id": 9, "visit_every": 3}]}}
    assert client.post("/missions/test/guidance", json=order).status_code == 200
    with watching(client) as events:
        reported = next(events)[1]
    [since] = [one["since_step"] for one in reported["guidance"]["orders"]]
    assert since >= 5 and reported["guidance"]["due"] == [{"sensor_id": 9, "visit_every": 3, "due": since + 2}]
    assert [reported["uavs"][number]["step"] for number in ("0", "1")] == [5, 4]


def test_a_fleet_that_is_silent_since_before_a_restart_is_lost(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "missions.db"
    with running(path) as (client, engine):
        fly(client, report, range(3))
        wait_until_written(engine)
        killed = copy_of(path, tmp_path / "killed.db")
    clock = Clock()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    clock.ahead_s = 120.0
    for stored in (path, killed):
        with running(stored) as (client, _):
            assert set(client.get("/missions/test").json()["alarms"]["uav_lost"]) == {"0", "1", "2"}
            assert 'aicvds_alarms{kind="uav_lost"} 3.0' in client.get("/metrics").text


def test_a_prompt_says_whether_the_llm_got_it(edge: Edge, report: Report) -> None:
    with serving(StubLlm().app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/value", json={"mode": "value"})
        asked = {
            mission: client.get(f"/missions/{mission}/decisions/{name}/prompt").json()["asked"]
            for mission in ("test", "value")
            for name in [decided(client, report(mission_id=mission))]
        }
    assert asked == {"test": True, "value": False}
