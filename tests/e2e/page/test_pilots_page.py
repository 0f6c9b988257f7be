"""What the one who flies seeks on the page: his names, his UAVs, his map before take-off, and the decisions of one."""

from __future__ import annotations

import re
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, expect
from starlette.responses import Response

from service.api.app import create_app
from service.config.settings import Settings
from shared.wire.names import MapShape, Names
from shared.wire.schemas import MissionSpec
from simulator.sites.files.world_folder import site_from_folder
from simulator.world.observation import decide_request
from tests.e2e.page.conftest import Open, violations
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, chat_completion, wait_for
from tests.support.waiting import PATIENCE_S
from tests.support.world_folders import EXAMPLE

pytestmark = pytest.mark.needs("chromium")

JSON = {"Content-Type": "application/json"}
AREA = [(1000.0, 1000.0), (2500.0, 1000.0), (2500.0, 1800.0), (1000.0, 1800.0)]
# Some 25 km around everything: the map shows all of it.
FENCE = [(-500.0, -500.0), (6500.0, -500.0), (6500.0, 5000.0), (-500.0, 5000.0)]


def make(edge: str, mission: str, **names: Any) -> None:
    site = site_from_folder(EXAMPLE)
    spec = site.named(MissionSpec(scenario=site.scenario))
    shapes = [
        *(spec.map or []),
        MapShape(kind="area", name="Village", points=AREA),
        MapShape(kind="no_fly", name="Airfield", points=[(x, y + 1500) for x, y in AREA]),
        MapShape(kind="fence", points=FENCE),
    ]
    spec = spec.model_copy(update={"map": shapes, **names})
    body = spec.model_dump_json(exclude_none=True)
    httpx.put(f"{edge}/missions/{mission}", content=body, headers=JSON, timeout=PATIENCE_S).raise_for_status()


def fly(edge: str, mission: str, steps: int, **of_itself: float) -> None:
    """Each UAV reports at its start, as if it stayed there."""
    observations, _ = site_from_folder(EXAMPLE).world().reset(seed=0)
    for step in range(steps):
        for uav in range(3):
            request = decide_request(uav, observations[f"uav_{uav}"], mission)
            request = request.model_copy(update={"step": step, **(of_itself if uav == 1 else {})})
            body = request.model_dump_json(exclude_none=False)
            httpx.post(f"{edge}/decide", content=body, headers=JSON, timeout=PATIENCE_S).raise_for_status()


def whole(page: Page, width: int) -> None:
    assert violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize(("scheme", "width"), [("light", 390), ("dark", 1280)])
def test_sensors_fences_and_the_users_map_are_there_before_take_off(
    visit: Open, edge: str, scheme: str, width: int
) -> None:
    mission = f"before-{width}"
    make(edge, mission)
    view = {"color_scheme": scheme, "viewport": {"width": width, "height": 900}, "timezone_id": "UTC"}
    page = visit(f"{edge}/?mission={mission}", **view)
    expect(page.locator("#fleet-none")).to_have_text("None has reported yet.")
    expect(page.locator(".mark.sensor")).to_have_count(14)
    expect(page.locator(".shape.fence").first).to_be_visible()
    expect(page.locator("#legend")).to_contain_text("fence: not to be left")
    expect(page.locator("#map .title")).to_contain_text(["Village"])
    expect(page.locator(".north")).to_be_visible()
    for time in ("00:04:07", "09:59:00", "23:00:00"):
        page.clock.set_fixed_time(f"2026-01-01T{time}Z")
        expect(page.locator("#clock")).to_have_text(f"{time} UTC · mission 00:00")
    # The whole fence is in the picture.
    box, fence = page.locator("#map").bounding_box(), page.locator("#map .shape.fence").bounding_box()
    assert box is not None and fence is not None
    assert box["x"] <= fence["x"] and fence["x"] + fence["width"] <= box["x"] + box["width"]
    page.locator("#sensor-3").focus()
    expect(page.locator("#readout")).to_have_text(
        re.compile(r"^kp-1\.58 \(sensor 3\): queue unknown, taken for .* battery unknown$")
    )
    whole(page, width)


@pytest.mark.parametrize(("scheme", "width"), [("dark", 390), ("light", 1280)])
def test_the_uavs_come_first_with_what_their_pilot_seeks(visit: Open, edge: str, scheme: str, width: int) -> None:
    mission = f"flown-{width}"
    make(edge, mission)
    fly(edge, mission, 2, battery_percent=22.4, height_m=98.7)
    page = visit(f"{edge}/?mission={mission}", color_scheme=scheme, viewport={"width": width, "height": 900})
    row = page.locator("#fleet-rows tr").nth(1)
    expect(row).to_contain_text("valve station, laps")
    expect(row).to_contain_text("22%")
    expect(row).to_contain_text("99 m")
    expect(row).to_contain_text(re.compile(r"\d+ s ago"))
    # Two steps within a second are no real flight: the waypoint's time is the mission's.
    expect(row).to_contain_text(re.compile(r"2 at mission 00:20, [\d,]+ m"))
    expect(row).to_contain_text(re.compile(r"kp-\d\.\d\d at \d+ m/s"))
    expect(page.locator("#fleet-rows tr").first).to_contain_text("not reported")
    expect(page.locator("#alarm-list")).to_contain_text("UAV battery below 25%: valve station, laps (22%)")
    expect(page.locator("#alarm-list")).to_contain_text(re.compile("In radio range but not heard: kp-|kp-"))
    # By the keyboard from the list to the map.
    page.get_by_role("button", name="valve station, laps", exact=True).focus()
    page.keyboard.press("Enter")
    expect(page.locator("#uav-1")).to_be_focused()
    expect(page.locator("#readout")).to_contain_text("valve station, laps (UAV 1) at step 1")
    # On a phone too the console is above the map and the cards.
    tops = [page.locator(place).bounding_box() for place in ("#fleet-title", "#operator", "#map", "#numbers")]
    assert [box["y"] for box in tops if box] == sorted(box["y"] for box in tops if box) and all(tops)
    whole(page, width)


def test_decisions_of_one_uav_sensor_or_source(visit: Open, edge: str) -> None:
    make(edge, "filtered")
    fly(edge, "filtered", 3)
    page = visit(f"{edge}/?mission=filtered")
    items = page.locator("#feed li")
    expect(items).to_have_count(9)
    page.get_by_label("UAV", exact=True).select_option(label="east, laps")
    expect(items).to_have_count(3)
    assert all("east, laps" in text for text in items.all_inner_texts())
    fly(edge, "filtered", 4)
    # Each of the four steps is decided again, or for the first time.
    expect(items).to_have_count(7)
    page.get_by_label("Sensor", exact=True).select_option(label="kp-0.10")
    expect(page.locator("#feed-none")).to_be_visible()
    page.get_by_label("Sensor", exact=True).select_option(label="all")
    page.get_by_label("Decided by", exact=True).select_option(index=1)
    expect(items).not_to_have_count(0)
    whole(page, 1280)


def test_who_decided_and_the_tokens_are_one_click_away(visit: Open, edge: str) -> None:
    make(edge, "asked", mode="guided")
    fly(edge, "asked", 2)
    page = visit(f"{edge}/?mission=asked")
    expect(page.locator("#fleet-rows tr")).to_have_count(3)
    expect(page.locator("#about")).to_be_hidden()
    page.locator("#deciders > summary").click()
    expect(page.locator("#about")).to_contain_text("mode guided")
    expect(page.locator("#deciders-numbers")).to_contain_text("Tokens saved")
    expect(page.locator("#tokens canvas")).to_have_count(1)
    whole(page, 1280)


def test_a_real_flights_next_waypoint_has_a_clock_time(visit: Open, edge: str) -> None:
    make(edge, "first", names=Names(sensors=["kp"], uavs=["north"]))
    fly(edge, "first", 1)
    page = visit(f"{edge}/?mission=first")
    expect(page.locator("#fleet-rows tr").first).to_contain_text(re.compile(r"north.*1 at \d\d:\d\d:\d\d, "))
    # Without a name of its own.
    expect(page.locator("#fleet-rows tr").nth(1)).to_contain_text("UAV 1")


class Letters(StubLlm):
    """Gives letter A ten times the probability of B."""

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        likeliest = [{"token": "A", "logprob": -0.1}, {"token": "B", "logprob": -2.4}]
        usage = {"prompt_tokens": 300, "completion_tokens": 1}
        return chat_completion(
            "A", usage, logprobs={"content": [{"token": "A", "logprob": -0.1, "top_logprobs": likeliest}]}
        )


def test_a_decision_shows_how_the_letters_probabilities_fell(visit: Open) -> None:
    with serving(Letters("A").app) as llm:
        settings = Settings(mode="llm", llm_url=f"{llm}/v1", llm_adapter="served", deadline_ms=60_000)
        with serving(create_app(settings)) as edge, httpx.Client(base_url=edge) as client:
            wait_for(client, "ready")
            make(edge, "letters", names=None)
            fly(edge, "letters", 1)
            page = visit(f"{edge}/?mission=letters")
            page.locator("#feed button").first.click()
            table = page.locator("#decision table").first
            expect(table.locator("th")).to_have_text(["Sensor", "Attention score", "LLM"])
            shares = [float(text) for text in table.locator("td:nth-child(3)").all_inner_texts()]
            assert sum(shares) == pytest.approx(1.0, abs=0.01) and max(shares) > 0.5
            whole(page, 1280)
            # The edge ends before the page would.
            page.close()
