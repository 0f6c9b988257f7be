"""An operator's notes over HTTP, read by the real embedded LLM: none is lost silently, none confirms the opposite."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import pytest

from service.api.app import create_app
from service.config.settings import Settings
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S

# A busy machine may need minutes for the three readings of a note.
pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
_LIMITS = (
    *("guidance.note_compiler.ANSWER_S", "guidance.note_compiler.TIMEOUT_S", "llm.connection.PROBE_TIMEOUT_S"),
    *("llm.probing.TOGETHER_TIMEOUT_S", "llm.calibration.TIMEOUT_S"),
)
LEAK = {"sensors": [{"sensor_id": 4, "visit_every": 3}]}
LEAK_AND_LIMIT = {**LEAK, "max_velocity": 9}
VISIT, LIMIT = "Visit sensor 4 at least once in every 3 steps.", "Never fly faster than 9 m/s."


@pytest.fixture(scope="module")
def client() -> Iterator[httpx.Client]:
    with ExitStack() as stack:
        patient = stack.enter_context(pytest.MonkeyPatch.context())
        for limit in _LIMITS:
            patient.setattr(f"service.{limit}", 900.0)
        url = stack.enter_context(serving(create_app(Settings(mode="llm", deadline_ms=60_000))))
        # A note waits for the LLM to load.
        yield stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S))


def read(client: httpx.Client, note: str, before: dict[str, Any] | None) -> dict[str, Any]:
    """The guidance of a mission with these orders in force, once the note was read."""
    mission = f"/missions/{re.sub('[^a-z0-9]', '-', note.lower())[:60]}"
    assert client.put(mission, json={"mode": "value"}).status_code == 200
    if before is not None:
        assert client.post(f"{mission}/guidance", json={"guidance": before}).status_code == 200
    assert client.post(f"{mission}/guidance", json={"note": note}).status_code == 200
    while (reported := client.get(f"{mission}/guidance").json())["status"] == "compiling":
        time.sleep(0.05)
    return dict(reported)


@pytest.mark.parametrize(
    ("note", "before", "ends", "after"),
    [
        ("Leak suspected at sensor 4: visit it every third step.", None, [], [VISIT]),
        ("Cancel all orders.", LEAK_AND_LIMIT, [VISIT, LIMIT], []),
        ("No need to visit sensor 4 any more.", LEAK_AND_LIMIT, [VISIT], [LIMIT]),
        ("Drop the visit order for sensor 4.", LEAK_AND_LIMIT, [VISIT], [LIMIT]),
        ("Visit sensor 4 every 3 steps until step 40.", None, [], [VISIT.replace(".", ", until step 40.")]),
        ("Fly at most 9 m/s for the next 10 steps.", LEAK, [], [VISIT, LIMIT.replace(".", ", until step 10.")]),
        ("Go to sensor 4 once.", None, [], ["Visit sensor 4 once, as soon as possible."]),
        ("Also visit sensor 2 every 5 steps.", LEAK, [], [VISIT, "Visit sensor 2 at least once in every 5 steps."]),
        ("Visit sensor 4 every 5 steps instead.", LEAK, [VISIT], ["Visit sensor 4 at least once in every 5 steps."]),
        ("Slow down, nothing faster than 6 m/s.", LEAK_AND_LIMIT, [LIMIT], [VISIT, "Never fly faster than 6 m/s."]),
        ("Ignore sensor 7.", LEAK, [], [VISIT, "Ignore what sensor 7 loses."]),
        ("Vist senser 4 evry 3 stpes.", None, [], [VISIT]),
        ("Sensor 4 needs a visit every 3 steps. Keep below 9 m/s.", None, [], [VISIT, LIMIT]),
    ],
)
def test_a_note_becomes_what_its_operator_means(
    client: httpx.Client, note: str, before: dict[str, Any] | None, ends: list[str], after: list[str]
) -> None:
    reported = read(client, note, before)
    assert (reported["status"], reported["ends"]) == ("proposed", ends), reported
    # Nothing of the note is missing, and so no doubt says it.
    assert not any("In no order" in doubt or "by itself" in doubt for doubt in reported["doubts"])
    confirmed = client.post(f"/missions/{reported['mission_id']}/guidance", json={"answer": "confirm"}).json()
    assert sorted(order["in_words"] for order in confirmed["orders"] if order["until"] is None) == sorted(after)


@pytest.mark.parametrize(
    ("note", "words"),
    [
        ("Visit sensor 4 every 3 steps, and be careful near the school.", "be careful near the school"),
        ("Visit sensor 4 every 3 steps until the rain stops.", "until the rain stops"),
        ("Visit sensor 4 every 3 steps, from 14:30 on.", "from 14:30 on"),
    ],
)
def test_words_that_are_in_no_order_are_quoted(client: httpx.Client, note: str, words: str) -> None:
    reported = read(client, note, None)
    assert reported["in_words"] == VISIT
    assert any(f"“{words}”" in doubt for doubt in reported["doubts"]), reported["doubts"]


@pytest.mark.parametrize("note", ["Slow down.", "Never visit sensor 4 every 3 steps.", "Don't cancel all orders."])
def test_what_is_not_understood_says_so_and_changes_nothing(client: httpx.Client, note: str) -> None:
    reported = read(client, note, LEAK)
    assert (reported["status"], reported["obeyed_in_words"]) == ("failed", VISIT)
    assert "unclear" in reported["failure"]


@pytest.mark.parametrize(
    "note",
    [
        "The leak at sensor 4 was a false alarm, we can stop checking it. Keep an eye on everything around the valve "
        "station instead.",
        "The 9 m/s cap is off, go as you please.",
        "The 3 m/s minimum is off, hover if you like.",
        "Sensor 4 is fixed, no longer every 3 steps.",
        "Ease off on sensor 4, every 3 steps was too much.",
        "Never mind the speed cap, go as fast as you like.",
        "Do not cancel the visits to sensor 4.",
        "Bitte Sensor 4 nicht mehr alle drei Schritte anfliegen.",
    ],
)
def test_no_note_begins_the_opposite_of_what_it_says(client: httpx.Client, note: str) -> None:
    reported = read(client, note, LEAK_AND_LIMIT)
    assert reported["begins"] == [], reported
    # It ends the order, is refused, or has a doubt.
    assert reported["status"] == "failed" or reported["ends"] or reported["doubts"]
