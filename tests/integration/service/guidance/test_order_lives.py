"""Each order's life: added or a replacement, withdrawn alone, ended by itself, recorded, kept through a restart."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.integration.service.api.test_routes import fields
from tests.integration.service.guidance.test_ended_orders import AT, say
from tests.integration.service.guidance.test_operator_guidance import Edge, Report
from tests.support.asking import PATHS, decide
from tests.support.processes import serving_edge
from tests.support.running import listening
from tests.support.stub_llm import http_answer, misbehaving, wait_for
from tests.support.waiting import PATIENCE_S, Gate, until

VISIT, SLOW = "Visit sensor 4 at least once in every 3 steps", "Never fly faster than 8 m/s"
LEAK = {"sensors": [{"sensor_id": 4, "visit_every": 3}]}


def ended(**end: Any) -> dict[str, Any]:
    """The orders of LEAK and a limit, with an end."""
    return {**LEAK, "max_velocity": 8, "ends": {"max_velocity": end}}


def spans(reported: dict[str, Any]) -> list[tuple[str, int, int | None]]:
    return [(order["name"], order["since_step"], order["until_step"]) for order in reported["orders"]]


def test_a_second_structure_is_added_unless_it_is_a_replacement(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={})
    say(client, guidance=LEAK)
    reported = say(client, guidance={"max_velocity": 8})
    assert (reported["obeyed_in_words"], reported["ended"]) == (f"{VISIT}. {SLOW}.", [])
    # Another limit replaces just that one.
    reported = say(client, guidance={"max_velocity": 6})
    assert reported["ended"] == [f"{SLOW}."]
    reported = say(client, guidance={"min_velocity": 2}, change="replace")
    assert reported["obeyed_in_words"] == "Never fly slower than 2 m/s."
    assert [(order["name"], order["until"] is None) for order in reported["orders"]] == [
        ("max_velocity", False),
        ("visit:4", False),
        ("max_velocity", False),
        ("min_velocity", True),
    ]


def test_one_order_is_withdrawn_by_its_name(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={})
    say(client, guidance={**LEAK, "max_velocity": 3})
    client.post("/decide", json=report(step=5))
    reported = say(client, answer="withdraw", orders=["max_velocity"])
    assert (reported["status"], reported["obeyed_in_words"]) == ("confirmed", f"{VISIT}.")
    assert spans(reported) == [("max_velocity", 0, 6), ("visit:4", 0, None)]
    assert client.post("/decide", json=report(step=6)).json()["velocity"] > 3
    unknown = client.post(AT, json={"answer": "withdraw", "orders": ["max_velocity"]})
    assert (unknown.status_code, fields(unknown)) == (409, ["orders"])
    assert "but visit:4" in unknown.json()["detail"]
    assert say(client, answer="withdraw", orders=["visit:4"])["status"] == "rejected"


def test_orders_are_said_and_withdrawn_by_the_users_names_too(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={"names": {"sensors": ["a", "b", None, "c", "kp-1.58"]}})
    named = VISIT.replace("sensor 4", "sensor 4 (kp-1.58)")
    assert say(client, guidance=LEAK)["obeyed_in_words"] == f"{named}."
    reported = say(client, answer="withdraw", orders=["visit:kp-1.58"])
    assert (reported["obeyed_in_words"], reported["ended"]) == (None, [f"{named}."])
    assert [(order["name"], order["in_words"]) for order in reported["orders"]] == [("visit:4", f"{named}.")]


def test_an_ended_order_says_why(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={})
    say(client, guidance={**ended(step=1), "min_velocity": 1})
    client.post("/decide", json=report(step=1))
    say(client, guidance={"min_velocity": 2})
    reported = say(client, answer="withdraw")
    reasons = {(order["name"], order["in_words"][-6:]): order["why"] for order in reported["orders"]}
    assert reasons == {
        ("max_velocity", "tep 1."): "its own end",
        ("min_velocity", " 1 m/s."[-6:]): "replaced",
        ("min_velocity", " 2 m/s."[-6:]): "withdrawn",
        ("visit:4", "steps."): "withdrawn",
    }


def test_visits_that_need_more_uavs_than_there_are_are_doubted(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={})
    every = [{"sensor_id": sensor, "visit_every": 2} for sensor in range(7)]
    assert say(client, guidance={"sensors": every[:6]})["doubts"] == []
    doubts = ["The visits need 3.5 UAVs in every step, and there are 3: some will be late."]
    assert say(client, guidance={"sensors": every})["doubts"] == doubts
    # One visit each is no interval.
    ends = {f"visit:{sensor}": {"visited": sensor} for sensor in range(7)}
    once = [{"sensor_id": sensor, "visit_every": 1} for sensor in range(7)]
    assert say(client, guidance={"sensors": once, "ends": ends})["doubts"] == []


def test_a_late_visit_is_an_alarm_of_the_mission(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={})
    say(client, guidance={"sensors": [{"sensor_id": 4, "visit_every": 3}]})
    client.post("/decide", json=report(step=0))
    assert "alarms" not in client.get("/missions/test").json()
    for step in range(1, 8):
        decision = client.post("/decide", json=report(step=step)).json()
        client.post("/feedback", json={"decision_id": decision["decision_id"], "cost": 0.0, "failed": True})
    assert client.get("/missions/test").json()["alarms"]["visit_late"] == {"4": 2}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("end", [{"step": 3}, {"steps": 3}])
def test_an_order_ends_at_its_step(edge: Edge, report: Report, end: dict[str, Any], path: str) -> None:
    client = edge()
    client.put("/missions/test", json={})
    reported = say(client, guidance={**ended(**end), "max_velocity": 2})
    assert reported["obeyed_in_words"] == f"{VISIT}. Never fly faster than 2 m/s, until step 3."
    # The last decisions of the steps before it too, which come after the first UAV's.
    asked = [[report(step=step, uav_id=uav) for uav in range(3)] for step in range(4)]
    velocities = [max(decision["velocity"] for decision in decide(client, path, *bodies)) for bodies in asked]
    assert max(velocities[:3]) <= 2 < velocities[3]
    reported = client.get(AT).json()
    assert (reported["obeyed_in_words"], reported["ended"]) == (
        f"{VISIT}.",
        ["Never fly faster than 2 m/s, until step 3."],
    )
    assert spans(reported) == [("max_velocity", 0, 3), ("visit:4", 0, None)]
    late = client.post(AT, json={"guidance": ended(step=4)})
    assert (late.status_code, fields(late)) == (422, ["guidance.ends.max_velocity.step"])


@pytest.mark.parametrize("path", PATHS)
def test_an_order_ends_at_its_time(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    time = [datetime(2030, 5, 1, 14, 0, tzinfo=UTC)]

    class Clock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return time[0].astimezone(tz)

    monkeypatch.setattr("service.guidance.operator_guidance.datetime", Clock)
    client = edge()
    client.put("/missions/test", json={})
    past = client.post(AT, json={"guidance": ended(time="2030-05-01T14:00:00Z")})
    assert (past.status_code, fields(past)) == (422, ["guidance.ends.max_velocity.time"])
    say(client, guidance=ended(time="2030-05-01T14:30:00Z"))
    time[0] += timedelta(minutes=29, seconds=59)
    decide(client, path, report())
    assert SLOW in client.get(AT).json()["obeyed_in_words"]
    time[0] += timedelta(seconds=1)
    decide(client, path, report(step=1))
    assert client.get(AT).json()["obeyed_in_words"] == f"{VISIT}."


@pytest.mark.parametrize(("mode", "answer", "reason"), [("llm", b"0 7", "answer_velocity"), ("guided", b"A", None)])
def test_a_decision_that_waits_for_the_llm_obeys_orders_that_are_confirmed_meanwhile(
    edge: Edge, report: Report, mode: str, answer: bytes, reason: str | None
) -> None:
    gate = Gate()

    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await gate.passed()
        await http_answer(b"200 OK", b'{"choices": [{"message": {"content": "%s"}}]}' % answer)(reader, writer)

    with listening(misbehaving(slowly)) as url, ThreadPoolExecutor(1) as pool, gate:
        client = edge(mode=mode, llm_url=f"{url}/v1", llm_model="stub-1", planner="off")
        wait_for(client, "ready")
        waiting = pool.submit(client.post, "/decide", json=report())
        until(lambda: gate.callers)
        say(client, guidance={"min_velocity": 1, "max_velocity": 1})
        gate.open()
        reported = waiting.result().json()
        assert (reported["velocity"], reported["reason"]) == (1, reason)


def test_an_order_ends_with_a_visit_that_succeeded(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={})
    sensor = client.post("/decide", json=report()).json()["sensor_id"]
    once = {"sensors": [{"sensor_id": sensor, "visit_every": 1}], "ends": {f"visit:{sensor}": {"visited": sensor}}}
    words = f"Visit sensor {sensor} once, as soon as possible."
    assert say(client, guidance=once)["obeyed_in_words"] == words
    for step, failed in ((1, True), (2, False)):
        decision = client.post("/decide", json=report(step=step)).json()
        assert decision["sensor_id"] == sensor
        # Presumed, and then failed: no visit.
        assert client.get(AT).json()["obeyed_in_words"] == words
        client.post("/feedback", json={"decision_id": decision["decision_id"], "cost": 0.0, "failed": failed})
    client.post("/decide", json=report(step=3))
    reported = client.get(AT).json()
    assert (reported["obeyed_in_words"], spans(reported)) == (None, [(f"visit:{sensor}", 1, 3)])
    # A single visit has no interval, and so no deadlines.
    assert "deadlines" not in client.get("/missions/test").json()


def test_an_order_that_ends_between_two_decisions_of_a_step_was_in_force_in_that_step(
    edge: Edge, report: Report
) -> None:
    client = edge()
    client.put("/missions/test", json={})
    sensor = client.post("/decide", json=report()).json()["sensor_id"]
    say(client, guidance={"max_velocity": 2, "ends": {"max_velocity": {"visited": sensor}}})
    decision = client.post("/decide", json=report(step=1)).json()
    assert (decision["sensor_id"], decision["velocity"] <= 2) == (sensor, True)
    client.post("/feedback", json={"decision_id": decision["decision_id"], "cost": 0.0})
    client.post("/decide", json=report(step=1, uav_id=1))
    reported = client.get(AT).json()
    assert (reported["obeyed_in_words"], spans(reported)) == (None, [("max_velocity", 1, 2)])


def test_ends_and_records_are_kept_through_a_restart(report: Report, tmp_path: Path) -> None:
    env = {"AICVDS_STORE": str(tmp_path / "missions.db"), "AICVDS_MODE": "value"}
    reported: dict[str, Any] = {}
    for step in range(3):
        with serving_edge(**env) as (url, process), httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            if step == 0:
                client.put("/missions/test", json={})
                reported = say(client, guidance=ended(steps=2))
            assert client.get(AT).json() == reported
            assert client.post("/decide", json=report(step=step)).status_code == 200
            reported = client.get(AT).json()
            process.kill()
    assert spans(reported) == [("max_velocity", 0, 2), ("visit:4", 0, None)]
