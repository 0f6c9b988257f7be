"""The page's alarms in a real browser: what is wrong, since when, and what to do."""

from __future__ import annotations

import re
import time
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse
from playwright.sync_api import expect

from service.api.app import create_app
from service.config.settings import Settings
from service.mission.mission import Mission
from shared.wire.schemas import UavState
from tests.e2e.page.conftest import HOSTILE, REFUSED, Open, Report, violations
from tests.support.running import serving
from tests.support.stored_missions import running
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.needs("chromium")


def test_alarms_name_the_sensors(visit: Open, edge: str, report: Report) -> None:
    body = report(mission_id="alarming", step=20)
    body["sensors"] |= {"queue": [60, 57, 3, 8, None], "battery": [49.0, 2.0, 47.5, 50.0, None]}
    body["sensors"] |= {"last_seen": [20, 20, 5, 20, None]}
    httpx.post(f"{edge}/decide", json=body, timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=alarming")
    alarms = page.locator("#alarm-list")
    expect(alarms).to_contain_text(re.compile(r"Believed full: S0"))
    expect(alarms).to_contain_text(re.compile(r"Full within 2 steps: S1 \(0\.6\)"))
    expect(alarms).to_contain_text("In radio range but not heard: S2 (step 20)")
    expect(alarms).to_contain_text(re.compile(r"Not heard for more than 10 steps: S\d \(never\).*S2 \(step 5\)"))
    expect(alarms).to_contain_text("Battery below 15%: S1 (4%). Since step 20. Change its battery.")
    # Believed full are only sensors of which something is known.
    expect(alarms).not_to_contain_text(re.compile(r"(Believed full|Full within)[^.]*S4"))
    expect(page.locator("#numbers")).to_contain_text("unknown of 6 never heard")
    expect(page.locator("#badge")).to_have_text("Flying")
    assert violations(page) == []


def test_alarms_name_uavs_visits_and_what_to_do(visit: Open, edge: str, report: Report) -> None:
    def decide(step: int, uav_id: int) -> None:
        body = report(mission_id="lost", step=step, uav_id=uav_id)
        httpx.post(f"{edge}/decide", json=body, timeout=PATIENCE_S).raise_for_status()

    decide(20, 0)
    orders = {"guidance": {"sensors": [{"sensor_id": 8, "visit_every": 2}]}}
    httpx.post(f"{edge}/missions/lost/guidance", json=orders, timeout=PATIENCE_S).raise_for_status()
    decide(20, 1)
    decide(21, 1)
    page = visit(f"{edge}/?mission=lost")
    alarms = page.locator("#alarm-list")
    expect(alarms).to_contain_text(re.compile(r"UAV off its path: UAV 1\. Since step 21\. Look at its autopilot"))
    expect(alarms).not_to_contain_text("UAV lost")
    expect(alarms).not_to_contain_text("Visit late")
    decide(25, 1)
    expect(alarms).to_contain_text("UAV lost: UAV 0 (step 20). Since step 20. Look for it at its last place")
    expect(alarms).to_contain_text(
        re.compile(r"Visit late: S8 \(due at step \d+\)\. Since step \d+\. Give it a weight")
    )
    # The page saw it first at step 21.
    expect(alarms).to_contain_text(re.compile(r"UAV off its path: UAV 1\. Since step 21\."))
    assert violations(page) == []


def test_a_late_decision_and_a_store_that_fails_are_alarms(
    visit: Open, report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.db"
    with running(path, create_on_decide="on") as (client, _):
        decided = client.post("/decide", json=report(mission_id="failing", deadline_ms=60_000))
        assert decided.json()["stored"]
        # The page asks whether the edge is ready, and it is not: 503.
        page = visit(f"{client.base_url}?mission=failing", expected=REFUSED)
        alarms = page.locator("#alarm-list")
        expect(alarms).to_contain_text("Full within 2 steps")
        expect(alarms).not_to_contain_text(re.compile("Store fails|Deadline missed"))
        path.unlink()
        # The machine is too slow.
        observe = Mission.observe

        def slowly(mission: Mission, uav: UavState, step: int) -> int:
            time.sleep(0.05)
            return observe(mission, uav, step)

        monkeypatch.setattr(Mission, "observe", slowly)
        client.post("/decide", json=report(mission_id="failing", step=7, deadline_ms=10))
        expect(alarms).to_contain_text(
            "Deadline missed: 1 of the newest 2 decisions. Since step 7. UAVs may decide on board"
        )
        expect(alarms).to_contain_text(re.compile(r"Store fails: .*m\.db was deleted.*\. Since step 7\."))
        assert violations(page) == []
        page.close()


def test_an_llm_of_no_use_is_an_alarm_in_its_servers_words(visit: Open, report: Report) -> None:
    app = FastAPI()
    app.post("/v1/chat/completions")(lambda: JSONResponse({"error": {"message": f"no quota {HOSTILE}"}}, 500))
    with serving(app) as llm, serving(create_app(Settings(mode="guided", llm_url=f"{llm}/v1"))) as edge:
        httpx.post(f"{edge}/decide", json=report(mission_id="unheard"), timeout=PATIENCE_S)
        page = visit(f"{edge}/?mission=unheard")
        expect(page.locator("#alarm-list")).to_contain_text(f"HTTP 500: no quota {HOSTILE}"[:60])
        assert page.evaluate("window.hacked") is None
        assert violations(page) == []
        page.close()


def test_alarms_name_bad_links_and_dead_radios(visit: Open, edge: str, report: Report) -> None:
    outcome = None
    for step in range(20, 60):
        body = report(mission_id="shadowed", step=step)
        body["sensors"] |= {"last_seen": [step] * 5, "channel_gain": [-90.0, -90.0, -90.0, -108.0, -90.0]}
        body["sensors"] |= {"queue": [60] * 5, "battery": [49.0, 49.0, 47.5, 50.0, 50.0]}
        answer = httpx.post(f"{edge}/decide", json=body | ({"outcome": outcome} if outcome else {}), timeout=PATIENCE_S)
        outcome = {"decision_id": answer.json()["decision_id"], "cost": 1.0, "failed": True}
        if httpx.get(f"{edge}/missions/shadowed", timeout=PATIENCE_S).json()["learned"]["failed_radios"]:
            break
    alarms = visit(f"{edge}/?mission=shadowed").locator("#alarm-list")
    expect(alarms).to_contain_text(re.compile(r"Radio probably dead: S\d"))
    expect(alarms).to_contain_text(re.compile(r"Links worse than modelled: .*S\d \(\d+ dB\)"))
