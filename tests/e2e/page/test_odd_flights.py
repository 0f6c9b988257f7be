"""What the page shows of a UAV far off its path, of a frozen view, and of a mission that is deleted."""

from __future__ import annotations

import re
from collections.abc import Iterator

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.e2e.page.conftest import REFUSED, Open, Report, edge_here
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.needs("chromium")


@pytest.fixture
def another_edge() -> Iterator[str]:
    with edge_here() as url:
        yield url


def is_within(page: Page, mark: str) -> bool:
    """Whether a mark's middle is within the map."""
    at, whole = page.locator(f"{mark} .craft").bounding_box(), page.locator("#map").bounding_box()
    assert at is not None and whole is not None
    x, y = at["x"] + at["width"] / 2, at["y"] + at["height"] / 2
    return whole["x"] <= x <= whole["x"] + whole["width"] and whole["y"] <= y <= whole["y"] + whole["height"]


@pytest.mark.parametrize("position", [[1700.0, -600.0], [2500.0, -900.0], [90_000.0, 0.0]])
def test_a_uav_off_its_path_is_on_the_map(visit: Open, edge: str, report: Report, position: list[float]) -> None:
    name = f"off-{position[0]:.0f}"
    httpx.post(f"{edge}/decide", json=report(mission_id=name), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission={name}")
    expect(page.locator("#uav-0")).to_be_visible()
    httpx.post(f"{edge}/decide", json=report(mission_id=name, step=1, position=position), timeout=PATIENCE_S)
    expect(page.locator("#alarms")).to_contain_text("UAV off its path")
    expect(page.locator("#uav-0")).to_have_attribute("aria-label", _text(position))
    assert is_within(page, "#uav-0")
    sensors = page.locator(".mark.sensor .body").evaluate_all("all => all.map(one => one.getBoundingClientRect().x)")
    # Beyond the map's size around it, the UAV is drawn at the border: the sensors stay apart.
    assert max(sensors) - min(sensors) > 30


def _text(position: list[float]) -> re.Pattern[str]:
    return re.compile(rf"{position[0]:,.0f} m east, {position[1]:,.0f} m north".replace("-", "[-−]"))


def test_a_frozen_view_stands_still_whatever_is_drawn_again(visit: Open, edge: str, report: Report) -> None:
    httpx.post(f"{edge}/decide", json=report(mission_id="frozen"), timeout=PATIENCE_S)
    page = visit(f"{edge}/?mission=frozen")
    expect(page.locator("#uav-0")).to_have_attribute("aria-label", _step(0))
    page.get_by_role("button", name="Freeze view").click()
    httpx.post(f"{edge}/decide", json=report(mission_id="frozen", step=1), timeout=PATIENCE_S)
    other = visit(f"{edge}/?mission=frozen")
    expect(other.locator("#uav-0")).to_have_attribute("aria-label", _step(1))
    page.set_viewport_size({"width": 700, "height": 900})
    page.emulate_media(color_scheme="dark")
    expect(page.locator("#badge")).to_have_text("View frozen")
    expect(page.locator("#uav-0")).to_have_attribute("aria-label", _step(0))
    page.get_by_role("button", name="Freeze view").click()
    expect(page.locator("#uav-0")).to_have_attribute("aria-label", _step(1))
    expect(page.locator("#badge")).to_have_text("Flying")


def _step(step: int) -> re.Pattern[str]:
    return re.compile(f"at step {step}, ")


def test_a_deleted_mission_leaves_the_header(visit: Open, another_edge: str, report: Report) -> None:
    httpx.post(f"{another_edge}/decide", json=report(mission_id="gone"), timeout=PATIENCE_S)
    page = visit(another_edge, expected=REFUSED)
    expect(page).to_have_title("gone · AIC-VDS")
    httpx.delete(f"{another_edge}/missions/gone", timeout=PATIENCE_S)
    expect(page.get_by_role("heading", name="No mission yet")).to_be_visible()
    expect(page.locator("#badge")).to_be_hidden()
    expect(page).to_have_title("AIC-VDS mission")
