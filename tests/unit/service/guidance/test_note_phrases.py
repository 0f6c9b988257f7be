"""The phrases of a note that code reads: withdrawals, ends, single visits, plain orders, and what is in no order."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.guidance.note_orders import BadOrders
from service.guidance.note_phrases import PhrasedNote
from shared.planning.orders import NO_GUIDANCE, Guidance, Impossible, SensorWish
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]
IN_FORCE = ("visit:4", "weight:7", "max_velocity")
VISIT = "Visit sensor 4 at least once in every 3 steps"
READ = Guidance(sensors=[SensorWish(sensor_id=4, visit_every=3)], max_velocity=9)


def phrased(note: str) -> PhrasedNote:
    return PhrasedNote(note, PAPER, IN_FORCE)


@pytest.mark.parametrize(
    ("note", "withdrawn"),
    [
        ("Cancel all orders.", ["*"]),
        ("please forget my notes", ["*"]),
        ("Everything back to normal.", ["*"]),
        ("No more orders, thanks", ["*"]),
        ("Drop the visit order for sensor 4.", ["visit:4"]),
        ("Cancel the visits to sensors 3 and 5-7, please.", ["visit:3", "visit:5", "visit:6", "visit:7"]),
        ("Cancel all visits.", ["visit:*"]),
        ("no need to visit 4", ["visit:4"]),
        ("There is no need to visit sensor four any more!", ["visit:4"]),
        ("Stop visiting sensor 4 now.", ["visit:4"]),
        ("Sensor 4 needs no visits any more.", ["visit:4"]),
        ("Remove the orders for sensor 4", ["visit:4", "weight:4"]),
        ("Stop ignoring sensor 7.", ["weight:7"]),
        ("Lift the speed limit.", ["*_velocity", "avoid:*"]),
    ],
)
def test_what_a_note_withdraws_is_read_whole(note: str, withdrawn: list[str]) -> None:
    found = phrased(note)
    assert (found.withdrawn, found.is_read) == (withdrawn, True)
    assert found.completed(NO_GUIDANCE, ()) == (NO_GUIDANCE, [])


@pytest.mark.parametrize(
    "note",
    [
        # Without such an order in force it may mean that the sensor does not count.
        "No need to visit sensor 5.",
        "Don't cancel all orders.",
        "Cancel all orders at step 40.",
        "If the leak is closed, cancel all orders.",
        "Shall we cancel all orders?",
        "Drop sensor 4 from the tour.",
        "Never leave sensor 4 unvisited for more than 3 steps.",
        "Do not visit sensor 4 every 3 steps.",
        "No need to visit sensor 4 once more.",
        "UAV 1: visit sensor 4 every 3 steps.",
        "Near sensor 4, fly at most 5 m/s.",
        "Visit sensor 4 every 3 steps, but only at night.",
    ],
)
def test_what_a_phrase_might_misread_is_for_the_llm(note: str) -> None:
    found = phrased(note)
    assert not found.orders and found.text == note


@pytest.mark.parametrize(
    ("note", "words"),
    [
        ("Visit sensor 4 every 3 steps.", f"{VISIT}."),
        ("Also visit sensor 4 every third step", f"{VISIT}."),
        ("Check sensor 4 every 30 seconds, please.", f"{VISIT}."),
        ("Visit sensor 4 in every step.", "Visit sensor 4 in every step."),
        ("Slow down, nothing faster than 32 km/h.", "Never fly faster than 8 m/s."),
        ("At least 3 m/s.", "Never fly slower than 3 m/s."),
        ("Don't fly at 5 m/s.", "Never fly at 5 m/s."),
        ("Leave sensor 4 alone.", "Ignore what sensor 4 loses."),
        ("Go to sensor 4 once.", "Visit sensor 4 once, as soon as possible."),
        ("Visit sensor 4 until it was visited.", "Visit sensor 4 once, as soon as possible."),
        ("Visit sensor 4 every 3 steps until step 40.", f"{VISIT}, until step 40."),
        ("Visit sensor 4 every 3 steps through step 40.", f"{VISIT}, until step 41."),
        ("For the next 5 minutes visit sensor 4 every 3 steps", f"{VISIT}, for 30 steps."),
        ("Max 9 m/s until sensor 4 was visited.", "Never fly faster than 9 m/s, until sensor 4 was visited."),
        ("Visit sensor 4 every 3 steps until further notice.", f"{VISIT}."),
        # The end is that of the orders in its sentence.
        (
            "Visit sensor 4 every 3 steps until step 40. Max 9 m/s.",
            f"{VISIT}, until step 40. Never fly faster than 9 m/s.",
        ),
        (
            "Visit sensor 4 every 3 steps, max 9 m/s, until step 40.",
            f"{VISIT}, until step 40. Never fly faster than 9 m/s, until step 40.",
        ),
    ],
)
def test_a_plain_order_and_its_end_need_no_llm(note: str, words: str) -> None:
    found = phrased(note)
    guidance, doubts = found.completed(NO_GUIDANCE, ())
    assert (found.is_read, guidance.in_words(), doubts) == (True, words, [])


@pytest.mark.parametrize("clock", ["14:30", "2:30 pm", "14.30 h", "14h30"])
def test_a_time_of_the_clock_is_the_next_one(clock: str) -> None:
    guidance, doubts = phrased(f"Max 9 m/s until {clock}.").completed(NO_GUIDANCE, ())
    end = guidance.ends["max_velocity"].time
    assert end is not None and not doubts
    assert (end.astimezone().hour, end.minute) == (14, 30)
    assert timedelta(0) < end - datetime.now(UTC) <= timedelta(days=1)


@pytest.mark.parametrize(
    ("note", "doubts"),
    [
        ("Sensor 4 every 3 steps, no more than 9 m/s.", []),
        ("Leak at sensor 4! It wants a visit every 3 steps; nobody over 9 m/s.", []),
        ("Sensor 4 every 3 steps, nobody over 9 m/s, and be careful.", ["In no order: “be careful”."]),
        ("Sensor 4 every 3 steps, nobody over 9 m/s, 5 metres up.", ["In no order: “5 metres up”."]),
        ("Sensor 4 every 3 steps, nobody over 9 m/s. Ignore the rest!", ["In no order: “ignore the rest”."]),
        ("Sensor 4 every 3 steps, nobody over 9 m/s, from 14:30 on.", ["In no order: “from 14:30 on”."]),
        (
            "Sensor 4 every 3 steps, nobody over 9 m/s until the rain stops.",
            ["No order ends by itself “until the rain stops”: withdraw it then."],
        ),
    ],
)
def test_a_doubt_quotes_what_is_in_no_order(note: str, doubts: list[str]) -> None:
    # The LLM's reading of the rest.
    assert phrased(note).completed(READ, {3.0, 4.0, 9.0}) == (READ, doubts)


@given(
    st.text(max_size=280)
    | st.lists(
        st.sampled_from(["cancel", "all", "orders", "visit", "sensor", "4", "until", "step", "9", "no", "max"])
    ).map(" ".join)
)
def test_any_note_is_read_or_refused(note: str) -> None:
    found = phrased(note)
    try:
        guidance, _ = found.completed(NO_GUIDANCE, ())
    except (BadOrders, Impossible, ValueError):
        return
    assert len(found.rest) == len(note.lower()) and isinstance(guidance, Guidance)
