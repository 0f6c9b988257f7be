"""Requests for missions that there are not: one is made by PUT, and by a decision only where that is allowed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.conftest import Edge
from tests.support.stored_missions import Report, running

Ask = Callable[[httpx.Client, str, dict[str, Any]], httpx.Response]


@pytest.fixture(autouse=True)
def by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AICVDS_CREATE_ON_DECIDE")


def uav(body: dict[str, Any]) -> dict[str, Any]:
    return {key: body[key] for key in ("uav_id", "position", "sensors")}


def decide(client: httpx.Client, mission_id: str, body: dict[str, Any]) -> httpx.Response:
    return client.post("/decide", json={**body, "mission_id": mission_id})


def decide_batch(client: httpx.Client, mission_id: str, body: dict[str, Any]) -> httpx.Response:
    return client.post("/decide/batch", json={"mission_id": mission_id, "step": body["step"], "uavs": [uav(body)]})


def decide_with_key(client: httpx.Client, mission_id: str, body: dict[str, Any]) -> httpx.Response:
    return client.post("/decide", json={**body, "mission_id": mission_id}, headers={"Idempotency-Key": "one"})


def decide_from_a_base(client: httpx.Client, mission_id: str, body: dict[str, Any]) -> httpx.Response:
    return client.post("/decide", json={**body, "mission_id": mission_id, "base": "0" * 32, "uplink": "delta"})


ASKS: list[Ask] = [decide, decide_batch, decide_with_key, decide_from_a_base]


def refused(answer: httpx.Response, mission_id: str) -> None:
    """The answer names the mission and what to do."""
    reported = answer.json()
    assert (answer.status_code, answer.headers["Content-Type"]) == (404, "application/problem+json"), answer.text
    assert [fault["field"] for fault in reported["errors"]] == ["mission_id"]
    for part in (f"no mission {mission_id}:", f"PUT /missions/{mission_id}", "AICVDS_CREATE_ON_DECIDE=on"):
        assert part in reported["detail"]


def listed(client: httpx.Client) -> list[str]:
    return [line["mission_id"] for line in client.get("/missions").json()["missions"]]


@pytest.mark.parametrize("ask", ASKS)
def test_a_decision_for_a_mistyped_mission_is_refused_and_records_nothing(
    tmp_path: Path, report: Report, ask: Ask
) -> None:
    with running(tmp_path / "m.db") as (client, _):
        client.put("/missions/patrol-7", json={}).raise_for_status()
        for mistyped in ("patrol-8", "Patrol-7", "DEFAULT", "patrol-7."):
            refused(ask(client, mistyped, report()), mistyped)
            assert client.get(f"/missions/{mistyped}").status_code == 404
            assert client.get(f"/missions/{mistyped}/attention").status_code == 404
            assert client.get(f"/missions/{mistyped}/guidance").status_code == 404
        assert listed(client) == ["patrol-7"]
        metrics = client.get("/metrics").text
        assert "aicvds_missions 1.0" in metrics
        assert "patrol-8" not in metrics
        assert ask(client, "patrol 7", report()).status_code == 422
    with running(tmp_path / "m.db") as (client, _):
        # What is in the store alone is found, and nothing else is there.
        assert listed(client) == ["patrol-7"]
        refused(ask(client, "patrol-8", report()), "patrol-8")
        if ask is not decide_from_a_base:
            assert ask(client, "patrol-7", report()).status_code == 200


def test_a_full_edge_refuses_a_mistyped_mission_by_its_name(edge: Edge, report: Report) -> None:
    client = edge(max_missions=1)
    client.put("/missions/only", json={}).raise_for_status()
    refused(decide(client, "onyl", report()), "onyl")


@pytest.mark.parametrize("ask", [decide, decide_batch, decide_with_key])
def test_the_default_mission_is_made_by_its_first_decision(edge: Edge, report: Report, ask: Ask) -> None:
    client = edge()
    assert ask(client, "default", report()).status_code == 200
    unnamed = {key: value for key, value in report(step=1).items() if key != "mission_id"}
    assert client.post("/decide", json=unnamed).json()["mission_id"] == "default"
    assert listed(client) == ["default"]


@pytest.mark.parametrize("ask", [decide, decide_batch, decide_with_key])
def test_a_setting_lets_decisions_make_missions(edge: Edge, report: Report, ask: Ask) -> None:
    client = edge(create_on_decide="on")
    assert ask(client, "new", report()).status_code == 200
    assert listed(client) == ["new"]


def test_a_mission_that_was_deleted_is_not_made_again(tmp_path: Path, report: Report) -> None:
    key = {"Idempotency-Key": "k"}
    with running(tmp_path / "m.db") as (client, _):
        client.put("/missions/test", json={}).raise_for_status()
        assert client.post("/decide", json=report(), headers=key).status_code == 200
        assert client.delete("/missions/test").status_code == 204
        refused(client.post("/decide", json=report(), headers=key), "test")
    with running(tmp_path / "m.db") as (client, _):
        refused(client.post("/decide", json=report(), headers=key), "test")
        client.put("/missions/test", json={}).raise_for_status()
        assert client.post("/decide", json=report(), headers=key).status_code == 200
