"""Orders that end: withdrawn whatever has become of the newest note, or replaced, which is said before and after."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.app import create_app
from service.config.settings import Settings
from service.mission.events import GuidanceChanged
from service.storage.rows import decode
from tests.integration.service.api.test_routes import fields
from tests.integration.service.guidance.test_operator_guidance import NOTE, ORDERS, OWN, Edge, Report, Scribe, guidance
from tests.support.processes import serving_edge
from tests.support.running import serving
from tests.support.storing import StoreHere
from tests.support.stub_llm import wait_for
from tests.support.waiting import PATIENCE_S

AT = "/missions/test/guidance"
OWN_IN_WORDS = [
    "Visit sensor 1 at least once in every 2 steps.",
    "Count each packet that sensor 1 loses 4 times.",
    "Never fly faster than 5 m/s.",
    "Never fly at 0 m/s.",
]
NOTED_IN_WORDS = "Visit sensor 3 at least once in every 3 steps."


def test_an_order_for_more_steps_than_a_mission_can_have_ends_with_the_last(edge: Edge, report: Report) -> None:
    client = edge(mode="value")
    client.put("/missions/test", json={}).raise_for_status()
    assert client.post("/decide", json=report(step=950_000)).status_code == 200
    given = {"sensors": [{"sensor_id": 1, "visit_every": 3}], "ends": {"visit:1": {"steps": 100_000}}}
    reported = client.post(AT, json={"guidance": given})
    assert reported.status_code == 200 and "1000000" in reported.text


def say(client: httpx.Client, **answer: Any) -> dict[str, Any]:
    response = client.post(AT, json=answer)
    assert response.status_code == 200, response.text
    reported: dict[str, Any] = response.json()
    return reported


@pytest.mark.parametrize(
    ("state", "answer"),
    [
        *((state, "withdraw") for state in ("compiling", "failed", "confirmed", "rejected")),
        ("confirmed", "reject"),
    ],
)
def test_orders_in_force_can_be_withdrawn_whatever_the_note(
    edge: Edge, report: Report, state: str, answer: str
) -> None:
    scribe = Scribe("hm" if state == "failed" else ORDERS)
    with serving(scribe.app) as url, scribe.gate:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value"})
        say(client, guidance={"max_velocity": 3})
        if state == "compiling":
            scribe.gate.shut()
        if state != "confirmed":
            say(client, note=NOTE)
        if state == "rejected":
            guidance(client, "proposed")
            say(client, answer="reject")
        before = guidance(client, state)
        assert before["obeyed_in_words"] == "Never fly faster than 3 m/s."
        reported = say(client, answer=answer)
        assert reported["obeyed_in_words"] is None
        assert (reported["begun"], reported["ended"]) == ([], ["Never fly faster than 3 m/s."])
        # What became of the note stays: an own structure that was withdrawn counts as rejected.
        assert reported["status"] == ("rejected" if state == "confirmed" else state)
        assert [reported[name] for name in ("note", "failure")] == [before[name] for name in ("note", "failure")]
        assert client.post("/decide", json=report()).json()["velocity"] > 3
        # Withdrawn twice is withdrawn.
        assert say(client, answer="withdraw") == reported


@pytest.mark.parametrize("ends", [{}, {"max_velocity": {"steps": 1}}])
def test_a_repeated_confirmation_brings_no_order_back(edge: Edge, report: Report, ends: dict[str, Any]) -> None:
    client = edge()
    client.put("/missions/test", json={"mode": "value"})
    said = say(client, guidance={"max_velocity": 3, "min_velocity": 1, "ends": ends})
    if ends:
        for step in range(3):
            assert client.post("/decide", json=report(step=step)).status_code == 200
    else:
        say(client, answer="withdraw", orders=["max_velocity"])
    left = say(client, answer="confirm")
    assert left["obeyed_in_words"] == "Never fly slower than 1 m/s." != said["obeyed_in_words"]
    say(client, answer="withdraw")
    refused = client.post(AT, json={"answer": "confirm"})
    assert refused.status_code == 409 and "there is nothing to confirm" in refused.text
    assert guidance(client, "rejected")["obeyed_in_words"] is None


def test_a_note_that_is_being_read_asks_for_patience(edge: Edge) -> None:
    scribe = Scribe(ORDERS)
    with serving(scribe.app) as url, scribe.gate:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value"})
        scribe.gate.shut()
        say(client, note=NOTE)
        refused = client.post(AT, json={"answer": "confirm"})
        assert refused.status_code == 409 and "wait until the note is read" in refused.text


def test_a_note_that_failed_cannot_be_rejected_and_ends_no_order(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={"mode": "value"})
    say(client, guidance={"max_velocity": 3})
    say(client, note=NOTE)
    guidance(client, "failed")
    refused = client.post(AT, json={"answer": "reject"})
    assert refused.status_code == 409 and "there is nothing to reject" in refused.text
    assert guidance(client, "failed")["obeyed_in_words"] == "Never fly faster than 3 m/s."


def test_orders_are_withdrawn_beside_a_reading_that_still_waits(edge: Edge) -> None:
    with serving(Scribe(ORDERS).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value"})
        say(client, guidance=OWN)
        say(client, note=NOTE)
        guidance(client, "proposed")
        reported = say(client, answer="withdraw")
        assert (reported["status"], reported["obeyed_in_words"], reported["in_words"]) == (
            "proposed",
            None,
            NOTED_IN_WORDS,
        )
        # Nothing is left that a confirmation ends.
        assert (reported["begins"], reported["ends"]) == ([NOTED_IN_WORDS], [])
        assert say(client, answer="confirm")["obeyed_in_words"] == NOTED_IN_WORDS


def test_without_orders_there_is_nothing_to_reject_and_withdrawing_changes_nothing(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={"note": NOTE})
    before = guidance(client, "failed")
    assert client.post(AT, json={"answer": "reject"}).status_code == 409
    assert say(client, answer="withdraw") == before


def test_what_a_confirmation_ends_is_said_before_and_after_and_in_the_journal(edge: Edge, tmp_path: Path) -> None:
    scribe = Scribe(ORDERS, f"{ORDERS}, fly at most 9 m/s", "visit sensor 3 every 4 steps")
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value", "note": NOTE})
        first = guidance(client, "proposed")
        assert (first["begins"], first["ends"]) == ([NOTED_IN_WORDS], [])
        say(client, answer="confirm")
        # An order that both name stays: it neither begins nor ends.
        say(client, note="Look at sensor 3 every 3 steps, at most 9 m/s.")
        second = guidance(client, "proposed")
        assert (second["begins"], second["ends"]) == (["Never fly faster than 9 m/s."], [])
        say(client, answer="confirm")
        say(client, note="Look at sensor 3 every 4 steps.")
        third = guidance(client, "proposed")
        fourth_step = "Visit sensor 3 at least once in every 4 steps."
        assert (third["begins"], third["ends"]) == ([fourth_step], [NOTED_IN_WORDS])
        limit = "Never fly faster than 9 m/s."
        assert (third["stays"], third["ends_if_replaced"]) == ([limit], [NOTED_IN_WORDS, limit])
        reported = say(client, answer="confirm", change="replace")
        assert (reported["begins"], reported["ends"]) == ([], [])
        assert (reported["begun"], reported["ended"]) == (third["begins"], third["ends_if_replaced"])
        # A structure takes effect at once, so that this is said afterwards.
        own = say(client, guidance=OWN, change="replace")
        assert (own["begun"], own["ended"]) == (OWN_IN_WORDS, [fourth_step])
        with sqlite3.connect(tmp_path / "missions-0.db") as db:
            rows = db.execute("SELECT body FROM journal WHERE kind = 'guided' ORDER BY seq DESC LIMIT 2").fetchall()
        db.close()
    events = [decode("guided", body) for (body,) in rows]
    written = [(event.state["begun"], event.state["ended"]) for event in events if isinstance(event, GuidanceChanged)]
    assert written == [(own["begun"], own["ended"]), (reported["begun"], reported["ended"])]


def test_of_two_operators_the_second_answers_no_reading_that_he_has_not_seen(edge: Edge) -> None:
    scribe = Scribe(ORDERS, "visit sensor 2 every 4 steps")
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value", "note": NOTE})
        seen = guidance(client, "proposed")["version"]
        say(client, note="Look at sensor 2 every 4 steps.")
        other = guidance(client, "proposed")
        for answer in ("confirm", "reject"):
            late = client.post(AT, json={"answer": answer, "version": seen})
            assert (late.status_code, fields(late)) == (409, ["version"])
        assert client.get(AT).json() == other
        assert say(client, answer="reject", version=other["version"])["status"] == "rejected"
        # Both reject the same reading: the second does not end the orders in force by it.
        again = client.post(AT, json={"answer": "reject", "version": other["version"]})
        assert (again.status_code, fields(again)) == (409, ["version"])
        assert client.post(AT, json={"answer": "confirm", "version": "x" * 65}).status_code == 422


def test_an_edge_that_was_killed_withdraws_the_orders_of_before(tmp_path: Path) -> None:
    env = {"AICVDS_STORE": str(tmp_path / "missions.db"), "AICVDS_MODE": "value"}
    with serving_edge(**env) as (url, process), httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        client.put("/missions/test", json={})
        say(client, guidance=OWN)
        say(client, note=NOTE)
        before = guidance(client, "failed")
        process.kill()
    with serving_edge(**env) as (url, process), httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        assert guidance(client, "failed") == before
        reported = say(client, answer="withdraw", version=before["version"])
        assert (reported["obeyed_in_words"], reported["ended"]) == (None, OWN_IN_WORDS)
        process.kill()
    later = create_app(Settings(mode="value"), StoreHere(tmp_path / "missions.db"))
    with serving(later) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        assert client.get(AT).json() == reported
