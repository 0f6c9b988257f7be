"""The report in a real browser, as a file: without an edge and without a network."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from service.api.app import create_app
from service.config.settings import Settings
from simulator.commands import simulate
from tests.e2e.page.conftest import Open
from tests.support.running import serving

pytestmark = pytest.mark.needs("chromium")

STEPS = 8


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a mission that an edge flew by learned values."""
    out = tmp_path_factory.mktemp("flown") / "run"
    options = ("--scenario", "pipeline", "--steps", str(STEPS), "--no-bound", "--out", str(out))
    with serving(create_app(Settings(mode="value", deadline_ms=60_000))) as url:
        assert simulate.main(["--edge", url, *options]) == 0
    return out


def decisions_of(run: Path) -> dict[int, list[dict[str, Any]]]:
    by_step = defaultdict(list)
    for line in (run / "decisions.jsonl").read_text(encoding="utf-8").splitlines():
        decision = json.loads(line)
        by_step[decision["step"]].append(decision)
    return by_step


def opened(visit: Open, run: Path, **context: Any) -> Page:
    page = visit((run / "report.html").as_uri(), offline=True, **context)
    expect(page.locator("#playback-player")).to_be_visible()
    return page


def rows(page: Page, table: str) -> list[list[str]]:
    script = "rows => rows.map(row => [...row.querySelectorAll('th, td')].map(cell => cell.innerText))"
    found: list[list[str]] = page.locator(f"#{table} tr").evaluate_all(script)
    return found


def test_every_step_shows_its_records(visit: Open, run: Path) -> None:
    page, by_step = opened(visit, run), decisions_of(run)
    summary = json.loads((run / "summary.json").read_bytes())
    page.locator("#playback-step").focus()
    for step in range(STEPS):
        expect(page.locator("#playback-now")).to_have_text(f"Step {step} of {STEPS}")
        assert rows(page, "playback-uavs") == [
            [
                f"U{d['uav_id']}", f"S{d['sensor_id']}", str(d["velocity"]), d["source"],
                "failed" if d["failed"] else str(d["collected"]), f"{d['cost']:.2f}",
            ]
            for d in by_step[step]
        ]  # fmt: skip
        shown = page.locator("#playback-map line:visible")
        assert shown.count() == len(by_step[step])
        assert page.locator("#playback-map line.failed:visible").count() == sum(d["failed"] for d in by_step[step])
        page.keyboard.press("ArrowRight")
    expect(page.locator("#playback-now")).to_have_text(f"End, after {STEPS} steps")
    lost = summary["lost_packets"]["aic_vds"]
    expect(page.locator("#playback-lost")).to_contain_text(f"{lost:,} packets lost so far")
    assert sum(int(row[-1]) for row in rows(page, "playback-sensors")) == lost > 0
    assert rows(page, "playback-uavs") == [] and page.locator("#playback-map .uav:visible").count() == 3


def test_the_keyboard_moves_it(visit: Open, run: Path) -> None:
    page = opened(visit, run)
    slider, now = page.locator("#playback-step"), page.locator("#playback-now")
    focusable = (slider, page.locator("#playback-play"), page.get_by_role("group", name="Map of the playback"))
    for focused in focusable:
        focused.focus()
        page.keyboard.press("End")
        expect(slider).to_have_value(str(STEPS))
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowLeft")
        expect(now).to_have_text(f"Step {STEPS - 1} of {STEPS}")
        page.keyboard.press("Home")
        page.keyboard.press("ArrowLeft")
        expect(now).to_have_text(f"Step 0 of {STEPS}")
        page.keyboard.press("ArrowUp")
        expect(slider).to_have_attribute("aria-valuetext", f"Step 1 of {STEPS}, {lost_at(page, 1)} lost")


def test_it_plays_and_pauses(visit: Open, run: Path) -> None:
    page = opened(visit, run)
    # The test is the timer.
    page.evaluate(
        "setInterval = (tick) => { window.tick = tick; return 1; }; clearInterval = () => { window.tick = null; }"
    )
    slider, button = page.locator("#playback-step"), page.locator("#playback-play")
    slider.focus()
    above = page.evaluate("scrollY")
    page.keyboard.press("Space")
    expect(button).to_have_text("Pause")
    page.evaluate("tick(); tick()")
    expect(slider).to_have_value("2")
    page.keyboard.press("Space")
    expect(button).to_have_text("Play")
    assert page.evaluate("[scrollY, tick]") == [above, None]
    button.focus()
    page.keyboard.press("Space")
    expect(button).to_have_text("Pause")
    page.evaluate("while (tick) tick()")
    expect(slider).to_have_value(str(STEPS))
    expect(button).to_have_text("Play")
    # At the end it starts anew, and a key that moves it stops it.
    button.click()
    expect(slider).to_have_value("0")
    page.keyboard.press("ArrowRight")
    expect(button).to_have_text("Play")
    expect(slider).to_have_value("1")


def lost_at(page: Page, index: int) -> str:
    script = "i => JSON.parse(document.getElementById('playback-data').textContent).frames[i].lost"
    lost = sum(page.evaluate(script, index))
    return f"{lost} packet{'' if lost == 1 else 's'}"


@pytest.mark.parametrize(("scheme", "width"), [("light", 390), ("dark", 1280)])
def test_it_is_accessible_and_fits(visit: Open, run: Path, scheme: str, width: int) -> None:
    page = opened(visit, run, viewport={"width": width, "height": 844}, color_scheme=scheme)
    page.locator("#playback-step").focus()
    page.keyboard.press("ArrowRight")
    found = Axe().run(page).response["violations"]
    assert [(one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    # No table hides a column: those of a phone are stacked.
    for table in page.locator(".scroll").all():
        assert table.evaluate("one => one.scrollWidth <= one.clientWidth"), table.inner_text()
    costliest = page.locator("#decisions td").last
    assert costliest.is_visible() and (width == 1280) == page.locator("#decisions thead").is_visible()
    letters = page.locator("#playback-map text").first.bounding_box()
    assert letters is not None and letters["height"] >= 10
    # The map has letters and discs in the theme's colours, apart from its card.
    ink, card = (
        page.evaluate("([one, part]) => getComputedStyle(document.querySelector(one))[part]", parts)
        for parts in (["#playback-map .uav text", "fill"], ["#playback .card", "backgroundColor"])
    )
    assert (sum(rgb(ink)) > 3 * 128) == (scheme == "dark") and (sum(rgb(card)) < 3 * 128) == (scheme == "dark")


def rgb(colour: str) -> list[int]:
    return [int(part) for part in colour.removeprefix("rgb(").removesuffix(")").split(",")]
