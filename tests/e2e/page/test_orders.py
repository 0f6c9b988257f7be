"""An operator's note, flown: report, page and ``GET /missions/{id}`` show the deadlines that the records show."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import expect

from service.api.app import create_app
from service.config.settings import Settings
from simulator.commands import simulate
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.world.observation import Observation
from tests.e2e.page.conftest import Open, violations
from tests.integration.service.guidance.test_operator_guidance import Scribe
from tests.support.running import serving
from tests.support.stub_llm import wait_for
from tests.support.undrawn import reports_undrawn
from tests.support.waiting import until

pytestmark = pytest.mark.needs("chromium")

NOTE = "Suspected leak at sensor 3: visit it every third step."
EVERY = 3
ORDERS = f"visit sensor 3 every {EVERY} steps"
FIRST, SECOND = (f"Visit sensor {sensor} at least once in every {every} steps." for sensor, every in ((3, 3), (2, 4)))
# Two of ten radios are dead, so that some visits fail.
FLIGHT = ("--scenario", "faulty", "--seed", "2", "--no-bound")


@contextmanager
def reading(*orders: str) -> Iterator[str]:
    """An edge in this process, whose LLM rewrites notes as these orders, one after another."""
    with serving(Scribe(*orders).app) as llm:
        settings = Settings(mode="llm", llm_url=f"{llm}/v1", llm_model="scribe", deadline_ms=60_000)
        with serving(create_app(settings)) as url:
            with httpx.Client(base_url=url) as client:
                wait_for(client, "ready")
            yield url


@pytest.fixture(scope="module")
def edge() -> Iterator[str]:
    with reading(ORDERS) as url:
        yield url


@pytest.fixture
def renewed() -> Iterator[str]:
    """An edge that reads two notes, and understands no third."""
    with reading(ORDERS, "visit sensor 2 every 4 steps", "hm") as url:
        yield url


def deadlines(out: Path, sensor: int, every: int, since: int = 0, end: int | None = None) -> list[int]:
    """Met and missed, window by window, of ``decisions.jsonl`` alone."""
    decisions = [json.loads(line) for line in (out / "decisions.jsonl").read_text(encoding="utf-8").splitlines()]
    served = {d["step"] for d in decisions if d["sensor_id"] == sensor and not d["failed"]}
    last = max(d["step"] for d in decisions) if end is None else end - 1
    windows = [range(step - every + 1, step + 1) for step in range(since + every - 1, last + 1)]
    met = sum(not served.isdisjoint(window) for window in windows)
    return [met, len(windows) - met]


def proposed(edge: str, mission: str) -> None:
    address = f"{edge}/missions/{mission}/guidance"
    until(lambda: httpx.get(address).json()["status"] == "proposed", lambda: httpx.get(address).text)


def guide(edge: str, mission: str, **answer: Any) -> None:
    assert httpx.post(f"{edge}/missions/{mission}/guidance", json=answer).status_code == 200


def shown(visit: Open, edge: str, mission: str) -> list[int]:
    """Met and missed on the mission page."""
    page = visit(f"{edge}/?mission={mission}")
    expect(page.locator("#badge")).to_have_text("Ended")
    page.locator("#operator > summary").click()
    text = page.locator("#deadlines-met").inner_text()
    found = re.search(r"are over: (\d+) met, (\d+) missed", text)
    assert found is not None, text
    return [int(number) for number in found.groups()]


def test_a_confirmed_note_shows_the_same_deadlines_everywhere(edge: str, visit: Open, tmp_path: Path) -> None:
    scenario = {"scenario": "faulty", "note": NOTE, "seed": 2}
    assert httpx.put(f"{edge}/missions/patrol", json={**scenario, "mode": "value"}).status_code == 200
    proposed(edge, "patrol")
    guide(edge, "patrol", answer="confirm")
    out = tmp_path / "run"
    assert simulate.main(["--edge", edge, *FLIGHT, "--mission", "patrol", "--out", str(out)]) == 0
    met, missed = counted = deadlines(out, 3, EVERY)
    # So that no number agrees by being 0.
    assert met > 0 and missed > 0
    operator = json.loads((out / "summary.json").read_bytes())["operator"]
    reported = httpx.get(f"{edge}/missions/patrol").json()["deadlines"]
    (flown,) = operator["in_force"]
    assert (flown["note"], flown["in_words"], flown["since_step"], flown["until_step"]) == (NOTE, FIRST, 0, None)
    assert operator["deadlines"] == reported
    assert reported == [{"sensor_id": 3, "visit_every": EVERY, "since": 0, "until": None, "met": met, "missed": missed}]
    report = (out / "report.html").read_text(encoding="utf-8")
    assert f"<td>visit deadlines met / missed</td><td>{met} / {missed}</td>" in report
    assert f"<td>sensor 3, every 3 steps</td><td>0</td><td>29</td><td>{met}</td><td>{missed}</td>" in report
    assert f"which may cost packets: {FIRST}" in report
    assert re.search(
        rf"<td>{FIRST}</td><td>0</td><td>29</td><td>[-0-9 :]+</td><td>in force at the end</td><td>“{NOTE}”</td>", report
    )
    assert shown(visit, edge, "patrol") == counted


def test_orders_that_change_in_flight_are_counted_while_they_are_in_force(
    edge: str, visit: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, decide = tmp_path / "run", EdgePilot.decide
    own = {"sensors": [{"sensor_id": 3, "visit_every": EVERY}, {"sensor_id": 5, "visit_every": 2}], "max_velocity": 12}

    def deciding(pilot: EdgePilot, uav: int, seen: Observation, taken: frozenset[int]) -> PilotChoice:
        at = (int(seen["step"][0]), uav)
        if at == (4, 0):
            proposed(edge, "watch")
            guide(edge, "watch", answer="confirm")
        # UAV 0 has decided already, so these are in force from the next step on.
        elif at == (12, 1):
            guide(edge, "watch", guidance=own)
        elif at == (20, 0):
            guide(edge, "watch", answer="reject")
        return decide(pilot, uav, seen, taken)

    monkeypatch.setattr(EdgePilot, "decide", deciding)
    with reports_undrawn():
        options = ("--mode", "value", "--mission", "watch", "--note", NOTE)
        assert simulate.main(["--edge", edge, *FLIGHT, *options, "--out", str(out)]) == 0
    spans = [(3, EVERY, 4, 20), (5, 2, 13, 20)]
    counted = [deadlines(out, *span) for span in spans]
    assert [sum(counts) for counts in counted] == [14, 6]
    names = ("sensor_id", "visit_every", "since", "until", "met", "missed")
    expected = [dict(zip(names, (*span, *counts), strict=True)) for span, counts in zip(spans, counted, strict=True)]
    operator = json.loads((out / "summary.json").read_bytes())["operator"]
    assert operator["deadlines"] == expected
    noted, own, limit = operator["in_force"]
    assert [(one["name"], one["since_step"], one["until_step"]) for one in (noted, own, limit)] == [
        ("visit:3", 4, 20),
        ("visit:5", 13, 20),
        ("max_velocity", 13, 20),
    ]
    # The note is the source of its own orders only.
    assert [one["note"] for one in (noted, own, limit)] == [NOTE, None, None]
    assert all(one["since"] <= one["until"] for one in (noted, own, limit))
    assert httpx.get(f"{edge}/missions/watch").json()["deadlines"] == expected
    assert shown(visit, edge, "watch") == [sum(counts) for counts in zip(*counted, strict=True)]


def test_the_page_says_which_orders_begin_stay_and_end_and_always_offers_to_withdraw_them(
    renewed: str, visit: Open
) -> None:
    assert httpx.put(f"{renewed}/missions/two", json={"mode": "value", "note": NOTE}).status_code == 200
    page = visit(f"{renewed}/?mission=two", expected=("409",))
    note, changes, in_force = (
        page.locator(f"#{name}") for name in ("note-input", "note-changes", "orders-list .words")
    )
    send, confirm, withdraw = (page.locator(name) for name in ("#note-form button", "#confirm", "#withdraw"))
    replace = page.get_by_role("button", name="Confirm, and replace all orders")
    # The first reading changes nothing else.
    expect(confirm).to_have_text("Confirm")
    for hidden in (changes, withdraw, replace):
        expect(hidden).to_be_hidden()
    confirm.click()
    expect(in_force).to_have_text([FIRST])
    expect(page.locator("#orders-list .hint")).to_contain_text("since step 0, ")
    expect(page.locator("#orders-list .hint")).to_contain_text(f"from the note “{NOTE}”")
    note.fill("Look at sensor 2 every 4 steps.")
    send.click()
    expect(changes.locator("li")).to_have_text(
        [f"Begins when you confirm: {SECOND}", f"Stays: {FIRST}", f"Ends too if you replace all orders: {FIRST}"]
    )
    expect(confirm).to_have_text("Confirm, and keep the other orders")
    expect(replace).to_be_visible()
    expect(withdraw).to_be_visible()
    assert violations(page) == []
    # Another operator answers meanwhile; what this one confirms is what the page shows.
    page.get_by_role("button", name="Freeze view").click()
    guide(renewed, "two", guidance={"max_velocity": 9}, change="replace")
    confirm.click()
    expect(page.locator("#operator-error")).to_contain_text("the guidance has changed since")
    page.get_by_role("button", name="Freeze view").click()
    expect(in_force).to_have_text(["Never fly faster than 9 m/s."])
    expect(page.locator("#orders-ended")).to_have_text(f"Ended by the last change: {FIRST}")
    note.fill("Mind sensor 2.")
    send.click()
    expect(page.locator("#note-state")).to_contain_text("was not understood")
    withdraw.click()
    expect(page.locator("#orders-words")).to_have_text("None.")
    expect(page.locator("#orders-ended")).to_contain_text("Never fly faster than 9 m/s.")
    expect(page.locator("#note-state")).to_contain_text("was not understood")
    expect(withdraw).to_be_hidden()


def test_a_structure_is_added_or_replaces_and_each_order_can_be_withdrawn(edge: str, visit: Open) -> None:
    assert httpx.put(f"{edge}/missions/own", json={"mode": "value"}).status_code == 200
    page = visit(f"{edge}/?mission=own")
    page.locator("#operator > summary").click()
    page.locator("#structure > summary").click()
    in_force = page.locator("#orders-list .words")
    limit, slow = "Never fly faster than 9 m/s, until step 40.", "Never fly slower than 2 m/s."
    for orders, button, left in (
        ({"sensors": [{"sensor_id": 3, "visit_every": 3}]}, "Add these orders", [FIRST]),
        ({"max_velocity": 9, "ends": {"max_velocity": {"step": 40}}}, "Add these orders", [FIRST, limit]),
        ({"min_velocity": 2}, "Replace all orders by these", [slow]),
        ({"sensors": [{"sensor_id": 2, "visit_every": 4}]}, "Add these orders", [slow, SECOND]),
    ):
        page.locator("#orders-input").fill(json.dumps(orders))
        page.get_by_role("button", name=button).click()
        expect(in_force).to_have_text(left)
    assert violations(page) == []
    page.get_by_role("button", name=f"Withdraw: {slow}").click()
    expect(in_force).to_have_text([SECOND])
    expect(page.locator("#orders-ended")).to_have_text(f"Ended by the last change: {slow}")
