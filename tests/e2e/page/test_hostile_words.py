"""Hostile words in a real browser: of LLMs, models, notes, folders. None runs, and none breaks the layout."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.responses import Response
from playwright.sync_api import Page, expect

from service.api.app import create_app
from service.config.settings import Settings
from simulator.commands import compare, simulate
from tests.e2e.page.conftest import Open, Report
from tests.support.running import serving
from tests.support.stub_llm import PROBE, StubLlm, chat_completion, wait_for
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.needs("chromium")

WIDTHS = (390, 1280)
SCRIPT = "<img src=x onerror='window.hacked=1'><script>window.hacked=1</script><svg onload=window.hacked=1>"
# What ends an attribute, a style, a script, a template, a line of a log or a word of a line.
ENDS = '"></td></table></style></script>{{7*7}}${7*7}<!--]]>javascript:window.hacked=1&lt;b&gt;'
LONG = "W" * 300
# An edge takes no longer name from a server's list.
MODEL = (SCRIPT + LONG)[:200]
# A note is printable and has at most 280 characters.
NOTES = (SCRIPT + ENDS, LONG[:280])
# Notes of which an order is read, and which a report therefore has once they are confirmed.
ORDER = "Visit sensor 4 every 3 steps."
CONFIRMED = (f"{SCRIPT.replace('1', 'true')}. {ORDER}", f"{LONG[:240]}. {ORDER}")


class Hostile(StubLlm):
    """It decides, and every third time answers with scripts."""

    async def models(self) -> dict[str, Any]:
        return {"data": [{"id": MODEL}]}

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        return chat_completion(
            f"{PROBE} 0" if probed else self.answer if len(self.bodies) % 3 else SCRIPT + ENDS + LONG
        )


@contextmanager
def hostile_edge(**settings: Any) -> Iterator[str]:
    with serving(Hostile("0 7").app) as llm:
        known = {"mode": "llm", "verify": "off", "deadline_ms": 60_000, "create_on_decide": "on", **settings}
        with serving(create_app(Settings(llm_url=f"{llm}/v1", **known))) as edge:
            with httpx.Client(base_url=edge, timeout=PATIENCE_S) as client:
                wait_for(client, "ready")
            yield edge


def harmless(page: Page) -> None:
    """Nothing ran, nothing became an element, and the page is as wide as its window."""
    assert page.evaluate("window.hacked") is None
    assert page.locator("img[src=x], td script, p script, dd script, [onerror], [onload]").count() == 0
    wide = page.evaluate(
        """() => [...document.body.querySelectorAll("*")].filter(one => !one.closest(".scroll, .card, svg, canvas") &&
        one.getBoundingClientRect().right > innerWidth + 1).map(one => one.outerHTML.slice(0, 99))"""
    )
    over = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert over <= 0, wide


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("note", NOTES)
def test_the_mission_page(visit: Open, report: Report, note: str, width: int) -> None:
    with hostile_edge() as edge:
        names = [SCRIPT[:64], ENDS[:64], LONG[:64]]
        area = {"kind": "no_fly", "name": SCRIPT[:64], "points": [[0, 0], [900, 0], [900, 900]]}
        spec = {"note": note, "names": {"sensors": names, "uavs": names}, "map": [area, area | {"name": LONG[:64]}]}
        httpx.put(f"{edge}/missions/m", json=spec, timeout=PATIENCE_S).raise_for_status()
        for step in range(12):
            body = report(mission_id="m", step=step)
            httpx.post(f"{edge}/decide", json=body, timeout=PATIENCE_S).raise_for_status()
        page = visit(f"{edge}/?mission=m", viewport={"width": width, "height": 900})
        expect(page.locator("#note-text")).to_have_text(note)
        expect(page.locator("body")).to_contain_text("window.hacked=1")
        harmless(page)
        for at in range(min(3, page.locator("#feed button").count())):
            page.locator("#feed button").nth(at).click()
            expect(page.get_by_role("dialog")).to_be_visible()
            harmless(page)
            page.keyboard.press("Escape")
        page.close()


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders with hostile names, of missions with confirmed hostile notes that a hostile model flew."""
    folders = []
    for number, note in enumerate(CONFIRMED):
        name = ("<img src=x onerror=window.hacked=1>" if number else "W" * 200) + f"{{{{7*7}}}}&amp;{number}"
        folders.append(tmp_path_factory.mktemp("flown") / name)
        with hostile_edge() as edge:
            with httpx.Client(base_url=f"{edge}/missions", timeout=PATIENCE_S) as client:
                client.put("/m", json={"note": note, "mode": "llm"}).raise_for_status()
                until(lambda: client.get("/m/guidance").json()["status"] == "proposed")
                client.post("/m/guidance", json={"answer": "confirm"}).raise_for_status()
            options = ("--mission", "m", "--steps", "4", "--no-bound", "--out", str(folders[-1]))
            assert simulate.main(["--edge", edge, *options]) == 0
        summary = json.loads((folders[-1] / "summary.json").read_text(encoding="utf-8"))
        assert summary["model"] == MODEL
    return folders


@pytest.mark.parametrize("width", WIDTHS)
def test_the_report(visit: Open, flown: list[Path], width: int) -> None:
    for folder, note in zip(flown, CONFIRMED, strict=True):
        page = visit((folder / "report.html").as_uri(), offline=True, viewport={"width": width, "height": 900})
        expect(page.locator("body")).to_contain_text("window.hacked=1")
        expect(page.locator("body")).to_contain_text(note)
        harmless(page)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_comparison(visit: Open, flown: list[Path], tmp_path: Path, width: int) -> None:
    out = tmp_path / "compare.html"
    assert compare.main([*map(str, flown), "--out", str(out)]) == 0
    page = visit(out.as_uri(), offline=True, viewport={"width": width, "height": 900})
    expect(page.locator("body")).to_contain_text("window.hacked=1")
    assert page.locator("thead th").count() == len(flown) + 1
    harmless(page)


@pytest.mark.parametrize(
    "path", ["/docs", "/redoc", "/%3Cscript%3Ewindow.hacked=1%3C/script%3E", "/missions/%3Cimg%3E"]
)
def test_no_other_page_repeats_words(visit: Open, path: str) -> None:
    with serving(create_app(Settings(mode="value"))) as edge:
        page = visit(edge + path, expected=("Failed to load resource",))
        assert json.loads(page.locator("body").inner_text())["status"] in (404, 422)
        harmless(page)
        page.close()
