"""Notes that say the opposite of the order in them, or less of it, and lists with ranges; phrases alone read them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import datetime

import pytest

from service.guidance import note_phrases
from service.guidance.note_orders import BadOrders
from service.guidance.note_phrases import PhrasedNote
from shared.planning.orders import NO_GUIDANCE, Guidance
from shared.world.scenario import MAX_SENSORS, SCENARIOS

PAPER = SCENARIOS["paper"]


def read(note: str) -> tuple[str, list[str], list[str]]:
    """The orders in words, the names withdrawn, and the doubts."""
    phrased = PhrasedNote(note, PAPER, ())
    guidance, doubts = phrased.completed(NO_GUIDANCE, frozenset())
    return guidance.in_words() if guidance else "", list(phrased.withdrawn), phrased.unsaid + doubts


@pytest.mark.parametrize(
    ("note", "sensors"),
    [
        ("Ignore sensors 1 and 3-5.", [1, 3, 4, 5]),
        ("Ignore sensors 1-3 and 5-7.", [1, 2, 3, 5, 6, 7]),
        ("Visit sensors 1, 3-5 every 4 steps.", [1, 3, 4, 5]),
        ("Visit S2-S4 every 3 steps.", [2, 3, 4]),
        ("Visit sensors 3, 5 & 7 every 4 steps.", [3, 5, 7]),
        ("Visit sensors 3 through 5 every 4 steps.", [3, 4, 5]),
    ],
)
def test_a_list_may_have_ranges(note: str, sensors: list[int]) -> None:
    words, withdrawn, doubts = read(note)
    assert (withdrawn, doubts) == ([], [])
    assert [sensor for sensor in range(10) if f"sensor {sensor} " in words] == sensors


@pytest.mark.parametrize(
    "note",
    [
        "Do not, under any circumstances, ignore sensor 4.",
        "Never, ever, ignore sensor 4.",
        "Forbidden: ignore sensor 4.",
        "Bob said: ignore sensor 4.",
        "No drone may, at any time, fly at least 10 m/s.",
        "Yesterday's order: fly at most 5 m/s.",
        "Visit sensor 4 every 3 steps. Cancel that.",
        "Visit sensor 4 every 3 steps. Just kidding!",
        "Nobody may cancel my orders.",
        "There is no reason to cancel the orders.",
        "Over the village, fly at most 5 m/s.",
        "While it rains, fly at most 5 m/s.",
        "On Monday, ignore sensor 4.",
        "Drone B: ignore sensor 4.",
        "Visit sensor 4 every 3 steps, not until 14:30.",
        "Visit sensor 4 every 3 steps, not before 9 am.",
        "Ignore sensor 4 until step 10, then visit sensor 5 every 3 steps.",
        "Fly at most 10 m/s for the next hour.",
        "Fly at most 10 m/s for the rest of the day.",
        "Visit sensor 4 every 3 steps until 14:30 UTC.",
        "Visit sensor 4 every 3 steps until 1.12.2026.",
        "Visit sensor 4 every 3 steps until 3 pm Friday.",
    ],
)
def test_what_may_be_denied_or_is_of_another_place_or_time_has_a_doubt(note: str) -> None:
    assert read(note)[2]


@pytest.mark.parametrize(
    ("note", "words"),
    [
        ("Ignore sensor 4.", "Ignore what sensor 4 loses."),
        ("Fly at most 10 m/s until step 1,200.", "Never fly faster than 10 m/s, until step 1200."),
        ("In general, fly at most 5 m/s.", "Never fly faster than 5 m/s."),
        ("Please, visit sensor 4 every 3 steps.", "Visit sensor 4 at least once in every 3 steps."),
    ],
)
def test_a_plain_order_has_no_doubt(note: str, words: str) -> None:
    assert read(note) == (words, [], [])
    assert read("Cancel all orders.") == ("", ["*"], [])


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize(
    ("now", "until", "end"),
    [
        ("2027-07-01T14:29", "14:30", "2027-07-01T14:30:00+02:00"),
        ("2027-07-01T14:29", "2:30 pm", "2027-07-01T14:30:00+02:00"),
        ("2027-07-01T14:29", "14.30 h", "2027-07-01T14:30:00+02:00"),
        ("2027-07-01T14:29", "14h30", "2027-07-01T14:30:00+02:00"),
        ("2027-07-01T14:30", "14:30", "2027-07-02T14:30:00+02:00"),
        ("2027-12-31T20:00", "8 am", "2028-01-01T08:00:00+01:00"),
        # Between the two the clocks are changed.
        ("2026-10-24T20:00", "14:30", "2026-10-25T14:30:00+01:00"),
        ("2027-03-27T20:00", "8 am", "2027-03-28T08:00:00+02:00"),
    ],
)
def test_a_time_of_the_clock_is_the_next_one_in_the_zone_of_its_day(
    monkeypatch: pytest.MonkeyPatch, now: str, until: str, end: str
) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
            return datetime.fromisoformat(now)

    monkeypatch.setattr(note_phrases, "datetime", Clock)
    guidance, doubts = PhrasedNote(f"Max 9 m/s until {until}.", PAPER, ()).completed(NO_GUIDANCE, frozenset())
    time_of_end = guidance.ends["max_velocity"].time
    assert doubts == [] and time_of_end is not None
    assert time_of_end.isoformat() == end


@pytest.mark.parametrize("between", [", and", ". Fly"])
def test_the_ends_of_two_near_velocities_are_kept_apart(between: str) -> None:
    note = f"Fly at most 12 m/s until step 40{between} at least 10 m/s until step 60."
    read, doubts = PhrasedNote(note, PAPER, ()).completed(NO_GUIDANCE, ())
    assert (read.max_velocity, read.min_velocity, doubts) == (12, 10, [])
    assert {name: end.step for name, end in read.ends.items()} == {"max_velocity": 40, "min_velocity": 60}


@pytest.mark.parametrize("value", [9, 13])
def test_a_limit_that_is_not_the_notes_velocity_is_no_reading(value: int) -> None:
    note = PhrasedNote("It is windy, 11 m/s is plenty for them in this", PAPER, ())
    assert note.completed(Guidance(max_velocity=11), (11.0,))[0] == Guidance(max_velocity=11)
    with pytest.raises(BadOrders, match="unclear"):
        note.completed(Guidance(max_velocity=value), (11.0,))


def test_a_range_has_every_sensor_of_the_largest_network_and_is_bounded() -> None:
    """A slip of the finger must not fill the memory."""
    for last, least, most in ((1999, 1999, 1999), (9999, MAX_SENSORS, 2 * MAX_SENSORS)):
        withdrawn = PhrasedNote(f"Cancel the visits to sensors 1-{last}.", PAPER, ["visit:4"]).withdrawn
        assert least <= len(withdrawn) <= most
        assert withdrawn[:3] == ["visit:1", "visit:2", "visit:3"]
