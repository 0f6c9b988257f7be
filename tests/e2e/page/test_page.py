"""The mission page in a real browser, of a real edge, while the simulator flies."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import expect

from simulator.commands import simulate
from tests.e2e.page.conftest import HOSTILE, REFUSED, Open, Report, Start, edge_here, violations
from tests.support.stub_llm import wait_for
from tests.support.undrawn import reports_undrawn
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.needs("chromium")

# Of the missions that are flown for a page: ten steps of three UAVs.
STEPS, DECISIONS = 10, 30


@pytest.fixture
def another_edge() -> Iterator[str]:
    """One without missions, which ends after the page that looks at it."""
    with edge_here() as url:
        yield url


@pytest.fixture(scope="module")
def flown(edge: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of the paper's mission, flown by learned values."""
    fly(edge, tmp_path_factory.mktemp("flown"))
    return f"{edge}/?mission={httpx.get(f'{edge}/missions').json()['newest']}"


def fly(url: str, out: Path, *options: str) -> None:
    with reports_undrawn():
        assert (
            simulate.main(["--edge", url, "--steps", str(STEPS), "--no-bound", "--out", str(out / "run"), *options])
            == 0
        )


def test_a_mission_appears_while_it_flies(another_edge: str, visit: Open, tmp_path: Path) -> None:
    url = another_edge
    page = visit(url)
    expect(page.get_by_role("heading", name="No mission yet")).to_be_visible()
    expect(page.locator("#empty-command")).to_have_text(f"aicvds simulate --edge {url} --out runs/mission")
    fly(url, tmp_path)
    expect(page.locator("#mission")).to_have_attribute("data-made", str(DECISIONS))
    expect(page.get_by_role("heading", name="No mission yet")).to_be_hidden()
    expect(page.locator(".sensor[role=button]")).to_have_count(10)
    expect(page.locator(".mark.uav")).to_have_count(3)
    expect(page.locator("#feed li")).to_have_count(DECISIONS)
    expect(page.locator("#connection")).to_have_text("Connected")
    assert page.locator(".trails line").count() > DECISIONS // 2
    assert len(set(page.locator(".trails line").evaluate_all("all => all.map(l => l.getAttribute('stroke'))"))) > 3
    for chart in ("loss", "latency"):
        expect(page.locator(f"#{chart} canvas")).to_have_count(1)
        expect(page.locator(f"#{chart}-text")).not_to_be_empty()
    expect(page.locator("#legend")).to_contain_text("round trip as the UAV measured it")
    expect(page.locator("#summary")).to_contain_text("failed transmissions")


def test_where_no_round_trip_is_told_the_edges_time_is_shown(visit: Open, edge: str, report: Report) -> None:
    reported = None
    for step in range(3):
        body = report(mission_id="silent", step=step, position=[500.0, 450.0 + 50 * step], outcome=reported)
        answer = httpx.post(f"{edge}/decide", json=body, timeout=PATIENCE_S).json()
        reported = {"decision_id": answer["decision_id"], "cost": 0.5}
    page = visit(f"{edge}/?mission=silent")
    expect(page.locator("#legend")).to_contain_text("the edge's own time: these UAVs do not report")
    expect(page.locator("#feed li").first).to_contain_text("ms at the edge")
    # Sensor 4 was never heard: it is drawn, and told apart.
    expect(page.locator("#sensor-4")).to_have_attribute("aria-label", re.compile("never heard, no visit"))
    expect(page.locator("#sensor-4")).to_have_class(re.compile("unheard"))


def test_every_decision_and_sensor_is_reached_by_keyboard(visit: Open, flown: str) -> None:
    page = visit(flown)
    first = page.locator("#feed button").first
    first.focus()
    for _ in range(DECISIONS - 1):
        page.keyboard.press("ArrowDown")
    expect(page.locator("#feed button").last).to_be_focused()
    page.keyboard.press("Home")
    expect(first).to_be_focused()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name=re.compile(f"^Step {STEPS - 1}: U\\d to S"))
    expect(dialog.get_by_role("region", name=re.compile("^Static block"))).to_contain_text(
        "You schedule data collection"
    )
    task = re.compile(r"^UAV at -?\d+,-?\d+\s+(\d+(,-?\d+){9}\s*){5}$")
    expect(dialog.get_by_role("region", name="Current task")).to_have_text(task)
    expect(dialog.locator("tr.chosen")).to_have_count(1)
    expect(dialog.locator("tbody tr")).to_have_count(5)
    expect(dialog).to_contain_text("No LLM was asked")
    expect(dialog.get_by_role("heading", name="Tokens")).to_have_count(0)
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    expect(first).to_be_focused()
    page.locator("#sensor-0").focus()
    for sensor in range(1, 10):
        page.keyboard.press("ArrowRight")
        expect(page.locator(f"#sensor-{sensor}")).to_be_focused()
        expect(page.locator("#readout")).to_contain_text(f"Sensor {sensor}: queue")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#readout")).to_contain_text(f"UAV 0 at step {STEPS - 1}")


@pytest.mark.long
def test_mode_guided_shows_candidates_with_probabilities_and_trust(visit: Open, start: Start, report: Report) -> None:
    url, _ = start(AICVDS_MODE="guided")
    with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        wait_for(client, "ready")
        answer = client.post("/decide", json=report(deadline_ms=30_000)).json()
        assert answer["source"] == "guided", answer["reason"]
        page = visit(url)
        page.locator("#feed button").first.click()
        dialog = page.locator("#decision")
        expect(dialog.locator("tbody tr")).to_have_count(len(answer["guided"]["candidates"]))
        best = answer["guided"]["candidates"][0]
        expect(dialog.locator("tbody tr").first).to_contain_text(f"{best['llm']:.3f}{best['mixture']:.3f}")
        expect(dialog.locator("meter")).to_have_count(len(answer["guided"]["trust"]))
        expect(dialog).to_contain_text("As the LLM received it.")
        # A row of the digits is a sentence for each.
        words = dialog.get_by_role("region", name="Current task in words")
        expect(words).to_contain_text(re.compile(r"A: sensor \d has about \d+ of 60 packets and overflows in"))
        expect(dialog.get_by_role("heading", name="Tokens")).to_be_visible()
        expect(page.locator("#tokens canvas")).to_have_count(1)
        assert violations(page) == []


def test_what_comes_from_outside_is_text(visit: Open, edge: str, report: Report) -> None:
    assert httpx.put(f"{edge}/missions/noted", json={"note": HOSTILE}, timeout=PATIENCE_S).status_code == 200
    httpx.post(f"{edge}/decide", json=report(mission_id="noted"), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=noted", expected=REFUSED)
    expect(page.locator("#note-text")).to_have_text(HOSTILE)
    page.locator("#feed button").first.click()
    expect(page.get_by_role("region", name=re.compile("^Static block"))).to_contain_text(HOSTILE)
    assert page.locator("img").count() == 0
    page.goto(f"{edge}/?mission={HOSTILE}")
    expect(page.locator("#trouble")).to_contain_text(f"There is no mission {HOSTILE}")
    expect(page.locator("#connection")).to_have_text("Connected")
    expect(page.locator("#trouble")).to_be_visible()
    assert page.locator("img").count() == 0
    assert page.evaluate("window.hacked") is None


@pytest.mark.parametrize(("scheme", "width"), [("light", 390), ("dark", 1280)])
def test_it_is_accessible_and_fits(visit: Open, flown: str, scheme: str, width: int) -> None:
    page = visit(flown, color_scheme=scheme, viewport={"width": width, "height": 844}, reduced_motion="reduce")
    expect(page.locator("#latency canvas")).to_have_count(1)
    assert violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.locator("#feed button").first.click()
    expect(page.get_by_role("region", name="Current task")).to_be_visible()
    assert violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.long
def test_one_of_several_missions_is_chosen(visit: Open, edge: str, flown: str, tmp_path: Path) -> None:
    first = flown.split("=")[1]
    fly(edge, tmp_path, "--scenario", "pipeline")
    page = visit(edge)
    expect(page).to_have_title(re.compile("^pipeline-0-"))
    expect(page.locator(".pipeline")).to_have_count(1)
    page.get_by_role("combobox", name="Mission").select_option(first)
    expect(page).to_have_title(f"{first} · AIC-VDS")
    expect(page.locator(".pipeline")).to_have_count(0)
    page.reload()
    expect(page).to_have_title(f"{first} · AIC-VDS")
    assert page.url.endswith(f"?mission={first}")


def test_paused_the_page_stands_still_and_goes_on_from_there(visit: Open, edge: str, report: Report) -> None:
    httpx.post(f"{edge}/decide", json=report(mission_id="paused"), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=paused")
    expect(page.locator("#feed li")).to_have_count(1)
    page.get_by_role("button", name="Freeze view").click()
    httpx.post(f"{edge}/decide", json=report(mission_id="paused", step=1), timeout=PATIENCE_S)
    # A page that is not paused has it.
    other = visit(f"{edge}/?mission=paused")
    expect(other.locator("#feed li")).to_have_count(2)
    httpx.post(f"{edge}/decide", json=report(mission_id="paused", step=2), timeout=PATIENCE_S)
    expect(other.locator("#feed li")).to_have_count(3)
    expect(page.locator("#feed li")).to_have_count(1)
    page.get_by_role("button", name="Freeze view").click()
    expect(page.locator("#feed li")).to_have_count(3)


def test_a_mission_that_is_deleted_and_made_again_begins_anew(visit: Open, edge: str, report: Report) -> None:
    for step in range(2):
        httpx.post(f"{edge}/decide", json=report(mission_id="again", step=step), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=again", expected=REFUSED)
    expect(page.locator("#feed li")).to_have_count(2)
    httpx.delete(f"{edge}/missions/again", timeout=PATIENCE_S)
    expect(page.locator("#trouble")).to_contain_text("There is no mission again, or no longer")
    httpx.post(f"{edge}/decide", json=report(mission_id="again", step=5), timeout=PATIENCE_S)
    expect(page.locator("#feed li")).to_have_count(1)
    expect(page.locator("#feed li")).to_contain_text("step 5")


@pytest.mark.long
def test_a_hundred_sensors_and_ten_uavs_ten_times_a_second(visit: Open, edge: str) -> None:
    with httpx.Client(base_url=edge, timeout=PATIENCE_S) as client:
        client.put("/missions/many", json={"scenario": "dense"})
        page = visit(f"{edge}/?mission=many")
        expect(page.locator("#mission")).to_have_attribute("data-made", "0")
        page.evaluate(
            """() => {
                window.updates = 0;
                new MutationObserver(() => { window.updates += 1; })
                    .observe(document.getElementById("mission"), {attributes: true, attributeFilter: ["data-made"]});
            }"""
        )
        steps = 50
        for step in range(steps):
            assert client.post("/decide/batch", json=batch(step)).status_code == 200
            if step % 5 == 4:
                expect(page.locator("#mission")).to_have_attribute("data-made", str(10 * (step + 1)))
        expect(page.locator(".sensor[role=button]")).to_have_count(100)
        expect(page.locator(".mark.uav")).to_have_count(10)
        expect(page.locator(".trails line")).to_have_count(10 * (steps - 1))
        expect(page.locator("#feed li")).to_have_count(100)
        expect(page.locator("#feed li").first).to_contain_text(f"step {steps - 1}")
        assert page.evaluate("window.updates") >= steps // 5


def batch(step: int) -> dict[str, Any]:
    """Ten UAVs that fly east over a hundred sensors, of which each hears all."""
    sensors = {
        "id": list(range(100)),
        "x": [50.0 + 100 * (i % 10) for i in range(100)],
        "y": [50.0 + 100 * (i // 10) for i in range(100)],
        "queue": [float((7 * i + 3 * step) % 60) for i in range(100)],
        "battery": [50.0] * 100,
        "channel_gain": [-90.0] * 100,
        "last_seen": [step] * 100,
    }
    uavs = [{"uav_id": u, "position": [10.0 + 15 * step, 50.0 + 100 * u], "sensors": sensors} for u in range(10)]
    return {"mission_id": "many", "step": step, "uavs": uavs}


def test_the_operator_gives_orders_and_sees_their_deadlines(visit: Open, edge: str, report: Report) -> None:
    httpx.post(f"{edge}/decide", json=report(mission_id="ordered"), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=ordered", expected=REFUSED)
    summary = page.locator("#operator-summary")
    expect(summary).to_have_text("no orders")
    page.locator("#operator > summary").click()
    page.locator("#structure > summary").click()
    orders = page.locator("#orders-input")
    orders.fill("{")
    page.get_by_role("button", name="Add these orders").click()
    expect(page.locator("#operator-error")).to_contain_text("These orders are no JSON")
    orders.fill('{"sensors": [{"sensor_id": 99, "visit_every": 2}]}')
    page.get_by_role("button", name="Add these orders").click()
    expect(page.locator("#operator-error")).to_contain_text("sensor 99 is unknown")
    orders.fill('{"sensors": [{"sensor_id": 3, "visit_every": 1}], "max_velocity": 9}')
    page.get_by_role("button", name="Add these orders").click()
    expect(summary).to_have_text("Visit sensor 3 in every step. Never fly faster than 9 m/s.")
    expect(page.locator("#operator-error")).to_be_empty()
    for step in (1, 2):
        httpx.post(f"{edge}/decide", json=report(mission_id="ordered", step=step), timeout=PATIENCE_S)
    expect(page.locator("#deadlines-list")).to_contain_text("S3, every 1 steps")
    # Step 0 was decided before the orders, and step 2 is not over.
    expect(page.locator("#deadlines-met")).to_contain_text("are over: 1 met, 0 missed")
    page.get_by_role("button", name="Withdraw all orders").click()
    expect(summary).to_have_text("no orders")
    # This edge has no LLM: a note is not understood, and the page says why.
    page.locator("#note-input").fill("The pipe near sensor 4 hums, look there now and then.")
    page.get_by_role("button", name="Send the note").click()
    expect(page.locator("#note-text")).to_have_text("The pipe near sensor 4 hums, look there now and then.")
    expect(page.locator("#note-words")).to_contain_text("the LLM is off")
    assert violations(page) == []


def test_the_page_says_what_the_records_say(visit: Open, edge: str, tmp_path: Path) -> None:
    """Its numbers are those of the flight's own files."""
    fly(edge, tmp_path, "--scenario", "pipeline")
    summary = json.loads((tmp_path / "run" / "summary.json").read_bytes())
    decisions = [json.loads(line) for line in (tmp_path / "run" / "decisions.jsonl").read_text().splitlines()]
    page = visit(f"{edge}/?mission={summary['mission_id']}")
    expect(page.locator("#mission")).to_have_attribute("data-made", str(summary["decisions"]))
    expect(page.locator("#badge")).to_have_text("Ended")
    names, values = (page.locator(f".numbers {part}").all_text_contents() for part in ("dt", ".value"))
    tiles = dict(zip(names, values, strict=True))
    assert tiles["Decisions"] == str(len(decisions))
    assert tiles["Failed"] == str(summary["failures"])
    # Mode value asks no LLM: nothing is said of tokens.
    assert "Tokens saved" not in tiles
    expect(page.locator("#latency canvas")).to_have_count(1)
    expect(page.locator("#tokens-text")).to_be_hidden()
    detail = page.locator(".numbers .detail").all_text_contents()
    assert any(f"cost {sum(d['cost'] for d in decisions):.1f}".removesuffix(".0") in text for text in detail)
    for source, count in summary["by_source"].items():
        if count:
            words = {"value": "learned values", "policy": "LLM-free policy"}[source]
            assert any(f"{count} {words}" in text for text in detail)


def test_the_page_stays_with_a_mission_that_flies_although_another_is_newer(
    another_edge: str, visit: Open, report: Report
) -> None:
    def decide(mission: str, step: int) -> None:
        httpx.post(f"{another_edge}/decide", json=report(mission_id=mission, step=step)).raise_for_status()

    decide("first", 0)
    page = visit(another_edge)
    expect(page).to_have_title("first · AIC-VDS")
    for newer in ("second", "third"):
        decide(newer, 0)
        expect(page.locator("#picker option").first).to_have_text(f"Newest: {newer}")
    expect(page).to_have_title("first · AIC-VDS")
