"""Questions, conditions and visits that end: they make no order, and ignore no sensor."""

from __future__ import annotations

import re

import pytest

from service.guidance.note_numbers import numbers_of
from service.guidance.note_orders import BadOrders
from shared.planning.orders import NO_GUIDANCE, Guidance
from tests.unit.service.guidance.test_note_phrases import phrased


@pytest.mark.parametrize(
    ("before", "quoted", "after"),
    [
        ("", "If the leak is closed, cancel all orders", ""),
        ("", "Should the dust get thicker, hold everybody below 8 m/s", ""),
        ("Max 9 m/s, and ", "in case it gets windy go down to 5", "."),
        ("", "Send someone to sensor 4 if the alarm rings", ". Morning!"),
        ("Quick one: ", "when did anybody look at 2, is it every 4 steps?", ""),
        ("", "Is 4 still visited every 3 steps?", ""),
    ],
)
def test_a_question_and_a_condition_are_quoted_and_not_read(before: str, quoted: str, after: str) -> None:
    found = phrased(before + quoted + after)
    assert (quoted.lower() in found.text.lower(), found.withdrawn) == (False, [])
    if found.orders:
        assert found.completed(NO_GUIDANCE, ())[1] == [f"In no order: “{quoted.lower()}”."]
    else:
        with pytest.raises(BadOrders, match=re.escape(f"“{quoted.lower()}” asks or has a condition")):
            found.completed(NO_GUIDANCE, ())


def test_half_as_much_is_no_time() -> None:
    assert [(n.value, n.unit) for n in numbers_of("sensor 6 counts half as much, half a step, half an hour")] == [
        (6, None),
        (0.5, None),
        (0.5, "steps"),
        (0.5, "h"),
    ]


@pytest.mark.parametrize(
    ("note", "read"),
    [
        ("If sensor 4 was not visited for 3 steps, go there.", {"visit:4": 3}),
        ("If you could visit sensor 4 every 3 steps", {"visit:4": 3}),
        ("How about a visit to sensor 4 every 3 steps?", {"visit:4": 3}),
        ("If we lose data of sensor 4, it costs twice as much.", {"weight:4": 2}),
        ("Could someone look at sensor 4 every 3 steps?", {"visit:4": 3}),
        ("Go slower if they fly faster than 9 m/s, just in case.", {"max_velocity": 9}),
    ],
)
def test_a_period_and_politeness_are_no_conditions(note: str, read: dict[str, float]) -> None:
    assert phrased(note).completed(Guidance.of(read, {}), (3.0, 4.0, 9.0, 2.0)) == (Guidance.of(read, {}), [])


def test_one_visit_that_the_llm_reads_as_many_ends_with_the_first() -> None:
    once = phrased("Could somebody swing by 2 and 9? Just the once each.").completed(
        Guidance.of({"visit:2": 1, "visit:9": 1}, {}), {2.0, 9.0}
    )[0]
    assert once.in_words() == ("Visit sensor 2 once, as soon as possible. Visit sensor 9 once, as soon as possible.")
    always = phrased("Keep someone at sensor 4").completed(Guidance.of({"visit:4": 1}, {}), {4.0})[0]
    assert always.in_words() == "Visit sensor 4 in every step."


@pytest.mark.parametrize(
    "note",
    [
        "They would be glad to see a UAV drop by sensor 4, a single time, then they leave us in peace.",
        "The auditors want one fresh reading from sensor 4, that is all",
        "Scrap everything I asked for, but not the triple weight on 5.",
        "Forget what I told you apart from 5. From step 9 on someone at 4 every 3 steps.",
    ],
)
def test_a_visit_or_a_withdrawal_ignores_no_sensor(note: str) -> None:
    read = Guidance.of({"weight:4": 0}, {})
    with pytest.raises(BadOrders, match="may end an order"):
        phrased(note).completed(read, {4.0, 5.0})


@pytest.mark.parametrize(
    "note",
    [
        "Flange on 4 is tight again, those extra rounds to sensor 4 can stop.",
        "The corner at sensor 4 is dry, you can stop with the regular flights to it.",
        "4 has calmed down: it may wait now",
    ],
)
def test_visits_that_may_stop_end_and_ignore_no_sensor(note: str) -> None:
    found = phrased(note)
    assert found.completed(Guidance.of({"weight:4": 0}, {}), {4.0})[0] == NO_GUIDANCE
    assert found.withdrawn == ["visit:4"]


def test_one_reading_ignores_no_sensor_without_a_word_that_does() -> None:
    note = phrased("I have changed the valve at sensor 5. Take one reading from there, more is not needed.")
    with pytest.raises(BadOrders, match="changed the valve"):
        note.completed(Guidance.of({"weight:5": 0}, {}), {5.0})


def test_a_weight_of_one_is_no_order_and_its_words_are_quoted() -> None:
    read = Guidance.of({"weight:5": 1}, {})
    guidance, doubts = phrased("Pls get snsr 5 1x asap, need its batt. level").completed(read, {5.0, 1.0})
    assert (guidance, doubts) == (NO_GUIDANCE, ["In no order: “pls get sensor 5 1x asap”."])


def test_a_sensors_own_number_is_no_weight() -> None:
    read = Guidance.of({"weight:7": 7}, {})
    with pytest.raises(BadOrders, match="worth a lot"):
        phrased("Data from sensor 7 is worth a lot").completed(read, {7.0})
    assert phrased("Data from sensor 7 has a weight of 7").completed(read, {7.0})[0] == read
