"""Requests and outcomes that come again, in another order, too late, or with another word."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.stored_missions import copy_of, running

Body = dict[str, Any]
Report = Callable[..., Body]


def test_a_request_sent_again_gets_the_same_answer_after_a_restart_too(tmp_path: Path, report: Report) -> None:
    key = {"Idempotency-Key": "radio-1-0001"}
    with running(tmp_path / "m.db") as (client, _):
        first = client.post("/decide", json=report(), headers=key).json()
        again = client.post("/decide", json=report(), headers=key).json()
        without = client.post("/decide", json=report()).json()
        assert again["decision_id"] == first["decision_id"] != without["decision_id"]
        assert client.get("/missions/test").json()["decisions"] == 2
        assert 'aicvds_decisions_total{reason="mode_value",source="value"} 2.0' in client.get("/metrics").text
        # As after a kill: no checkpoint was taken.
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
    for path in (tmp_path / "m.db", copied):
        with running(path) as (client, _):
            assert client.post("/decide", json=report(), headers=key).json()["decision_id"] == first["decision_id"]
            other = client.post("/decide", json=report(step=1), headers=key)
            assert (other.status_code, other.json()["errors"][0]["field"]) == (422, "Idempotency-Key")
            assert client.get("/missions/test").json()["decisions"] == 2


@pytest.mark.parametrize("key", ["", "x" * 65, "two words"])
def test_a_key_has_bounds(tmp_path: Path, report: Report, key: str) -> None:
    with running(tmp_path / "m.db") as (client, _):
        answer = client.post("/decide", json=report(), headers={"Idempotency-Key": key})
        assert answer.status_code == 422
        assert client.get("/missions/test").status_code == 404


def test_the_same_batch_at_once_is_decided_once(tmp_path: Path, report: Report) -> None:
    uavs = [{k: report()[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in range(3)]
    body = {"mission_id": "test", "step": 0, "uavs": uavs}
    with running(tmp_path / "m.db", mode="guided", llm_gguf="none") as (client, _):
        answers: list[Any] = []

        def ask() -> None:
            answers.append(client.post("/decide/batch", json=body, headers={"Idempotency-Key": "k"}).json())

        threads = [threading.Thread(target=ask) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        reported = {tuple(d["decision_id"] for d in answer["decisions"]) for answer in answers}
        assert len(reported) == 1
        assert client.get("/missions/test").json()["decisions"] == 3


def test_only_so_many_answers_are_remembered(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        for number in range(60):
            client.post("/decide", json=report(step=number), headers={"Idempotency-Key": f"k{number}"})
        assert len(engine.missions.loaded[0].idempotent_answers._answers) == 24


def test_a_batch_counts_as_many_answers_as_it_has(tmp_path: Path, report: Report) -> None:
    uavs = [{k: report()[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in range(3)]

    def ask(client: httpx.Client, number: int) -> str:
        body = {"mission_id": "test", "step": 0, "uavs": uavs}
        answer = client.post("/decide/batch", json=body, headers={"Idempotency-Key": f"k{number}"})
        reported: str = answer.json()["decisions"][0]["decision_id"]
        return reported

    with running(tmp_path / "m.db") as (client, engine):
        first = [ask(client, number) for number in range(10)]
        assert len(engine.missions.loaded[0].idempotent_answers._answers) == 8
        # As after a kill: no checkpoint was taken.
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
    for path in (tmp_path / "m.db", copied):
        with running(path) as (client, _):
            # The newest eight a UAV; those before are other requests by now.
            assert [ask(client, number) for number in range(2, 10)] == first[2:]
            assert ask(client, 0) != first[0]


@pytest.mark.parametrize("change", [{"cost": 0.7}, {"failed": True}])
def test_an_outcome_that_contradicts_an_earlier_one_does_not_count(edge: Any, report: Report, change: Body) -> None:
    client = edge()
    decision = client.post("/decide", json=report()).json()["decision_id"]
    outcome = {"decision_id": decision, "cost": 0.5, "failed": False}
    assert client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"] == "applied"
    assert client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"] == "duplicate"
    other = client.post("/feedback", json={"mission_id": "test", **outcome, **change})
    assert (other.status_code, other.json()["errors"][0]["field"]) == (409, "cost")
    # It may be that the earlier one was forged: who asks for a decision gets it.
    assert client.post("/decide", json=report(step=1, outcome={**outcome, **change})).status_code == 200
    again = client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"]
    status = client.get("/missions/test").json()
    assert (again, status["decisions"], status["feedback"]) == ("duplicate", 2, 1)
    assert 'aicvds_feedback_total{result="contradicted"} 2.0' in client.get("/metrics").text


def test_a_forged_outcome_does_not_refuse_the_fleet_its_batch(edge: Any, report: Report, caplog: Any) -> None:
    client = edge()
    one = {key: report()[key] for key in ("position", "sensors")}
    first = {"mission_id": "test", "step": 0, "uavs": [{"uav_id": uav, **one} for uav in range(3)]}
    ids = [answer["decision_id"] for answer in client.post("/decide/batch", json=first).json()["decisions"]]
    forged = {"mission_id": "test", "decision_id": ids[2], "cost": 13.0, "failed": True}
    assert client.post("/feedback", json=forged).json()["result"] == "applied"
    one = {key: report(step=1)[key] for key in ("position", "sensors")}
    uavs = [{"uav_id": uav, "outcome": {"decision_id": ids[uav], "cost": 0.2}, **one} for uav in range(3)]
    second = client.post("/decide/batch", json={"mission_id": "test", "step": 1, "uavs": uavs})
    assert (second.status_code, len(second.json()["decisions"])) == (200, 3)
    assert client.get("/missions/test").json()["feedback"] == 3
    reported = [record.getMessage() for record in caplog.records if record.name == "service.edge.feedback"]
    assert len(reported) == 1 and "mission test" in reported[0] and ids[2] in reported[0]


def test_outcomes_may_come_in_any_order_but_not_too_late(edge: Any, report: Report) -> None:
    client = edge()
    ids = [client.post("/decide", json=report(step=step)).json()["decision_id"] for step in range(20)]
    reported = [
        client.post("/feedback", json={"mission_id": "test", "decision_id": i, "cost": 0.1}) for i in reversed(ids)
    ]
    assert [answer.status_code for answer in reported] == [200] * 8 + [404] * 12
    assert client.get("/missions/test").json()["feedback"] == 8
