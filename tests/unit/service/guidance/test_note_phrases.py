"""The phrases of a note that code reads: withdrawals, ends, single visits, plain orders, and what is in no order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.guidance.note_numbers import numbers_of
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
        ("There's no need to keep popping over to sensor 4 anymore.", ["visit:4"]),
        ("Stop ignoring sensor 7.", ["weight:7"]),
        ("Control room has what it needed, 7 can go back to normal.", ["weight:7"]),
        ("Treat sensor 7 like any other sensor.", ["weight:7"]),
        ("Drop everything we had before.", ["*"]),
        ("Forget all the orders I gave you earlier", ["*"]),
        ("Lift the speed limit.", ["*_velocity", "avoid:*"]),
        ("Speed cap is off again.", ["*_velocity", "avoid:*"]),
        ("Sensor 7 got a new battery and counts again like all the others.", ["weight:7"]),
        ("Wind's dropped, scrap the 11 m/s cap.", ["max_velocity"]),
        ("Wind has dropped, so the speed cap can go.", ["max_velocity"]),
        ("Honestly, who put that speed cap in?! Take it off, now.", ["max_velocity"]),
        ("speed limit dropped", ["*_velocity", "avoid:*"]),
        ("crew fixed 4, no need to go there anymore. Leave the rest as it is", ["visit:4"]),
        ("All good at sensor 4, nobody needs to go there. Everything else stays as it is.", ["visit:4"]),
        ("4 is fine again, we don't need to check on it", ["visit:4"]),
        ("calib on 7 finished, treat it like the rest again", ["weight:7"]),
        ("Crew is at 4 now, drop the extra visits there.", ["visit:4"]),
        ("sensor 4 has been swapped so stop the trips to it", ["visit:4"]),
        ("scrap what I said about 4, rest stays the same", ["visit:4", "weight:4"]),
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
        "Fly at most 9 m/s? Never!",
        "Don't cancel all orders.",
        "Cancel all orders at step 40.",
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
        ("Please keep moving.", "Never fly at 0 m/s."),
        ("No hovering, nobody stands still", "Never fly at 0 m/s."),
        ("Someone pop over to 4 once for a reading.", "Visit sensor 4 once, as soon as possible."),
        ("Would be good to know: one of you, please go to sensor 4 once", "Visit sensor 4 once, as soon as possible."),
        ("Somebody check 4 every 3 steps", f"{VISIT}."),
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


@pytest.mark.parametrize(
    ("note", "doubts"),
    [
        ("Sensor 4 every 3 steps, no more than 9 m/s.", []),
        ("Leak at sensor 4! It wants a visit every 3 steps; nobody over 9 m/s.", []),
        ("Sensor 4 every 3 steps, nobody over 9 m/s, and be careful.", ["In no order: “be careful”."]),
        ("Sensor 4 every 3 steps, only this. Nobody over 9 m/s.", ["In no order: “only this”."]),
        (
            "Sensor 4 every 3 steps. Nobody over 9 m/s around the school.",
            ["In no order: “nobody over 9 m/s around the school”."],
        ),
        (
            "Sensor 4 every 3 steps, nobody over 9 m/s today.",
            ["No order ends by itself “today”: withdraw it then."],
        ),
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


@pytest.mark.parametrize(
    ("note", "read"),
    [
        # Two that an operator wrote, and that the adapter read as the opposite.
        (
            "The leak at sensor 4 was a false alarm, we can stop checking it. Keep an eye on everything around the "
            "valve station instead.",
            {f"visit:{sensor}": 1 for sensor in range(PAPER.sensors)},
        ),
        ("The 3 m/s minimum is off, hover if you like.", {"min_velocity": 3}),
        ("Sensor 4 is fixed, no longer every 3 steps.", {"visit:4": 3}),
        ("The 9 m/s cap no longer applies.", {"max_velocity": 9}),
        ("9 m/s was too slow.", {"max_velocity": 9}),
        ("You need not keep to 3 steps at sensor 4.", {"visit:4": 3}),
        ("Hovering is allowed again.", {"avoid:0": 0}),
        # Another operator's, likewise.
        (
            "Stay away from sensor 9 until step 20, there is blasting, after that go there every 2 steps.",
            {"visit:9": 2, "weight:9": 0},
        ),
        ("Stay away from sensor 9.", {"visit:9": 2}),
        ("Only sensors 0, 1 and 2 matter.", {"weight:0": 0, "weight:1": 0}),
        ("Do not cancel the visits to sensor 5.", {"weight:5": 0}),
        ("For the next 5 steps 12 m/s is fine.", {"min_velocity": 12}),
        ("Never mind the speed cap, go as fast as you like.", {"avoid:0": 0}),
        ("Pause the visits to sensor 4 for 10 steps.", {"visit:4": 10}),
        ("Climb to 150 m over sensor 3 and take a photo each time you pass.", {"visit:3": 1}),
        ("Keep an eye on all sensors near the school.", {f"visit:{sensor}": 1 for sensor in range(PAPER.sensors)}),
        # Of two more.
        ("It's sensor 6 that wants a visit, not sensor 9.", {"weight:9": 0}),
        ("Only sensor 4 is left, you can drop the visits to 6 and 8.", {"weight:6": 0, "weight:8": 0}),
        ("There's a school by sensor 3, so give the yard a wide berth.", {"max_velocity": 3}),
        ("Every sensor looked in on, except 9.", {"visit:4": 9}),
        ("If the queue at sensor 0 ever gets past forty packets, head over there.", {"visit:0": 40}),
        ("Keep everybody to 36 km/h tops.", {"min_velocity": 10}),
        ("2 got a new battery, so stop ignoring it.", {"weight:2": 0}),
        ("Leave 6, 7 and 8 on the schedule they have.", {"avoid:6": 6, "avoid:7": 7, "avoid:8": 8}),
        ("Never visit sensor 4 every 3 steps.", {"visit:4": 3}),
    ],
)
def test_an_order_that_the_words_may_end_is_refused(note: str, read: dict[str, float]) -> None:
    with pytest.raises(BadOrders, match="may end an order or mean a part of the fleet"):
        phrased(note).completed(Guidance.of(read, {}), {*read.values(), 4.0})


def test_an_end_does_not_reach_a_limit_in_another_unit() -> None:
    note = phrased("Fly at least 10 knots. Max 12 m/s for the next 20 steps.")
    guidance, doubts = note.completed(NO_GUIDANCE, ())
    assert (guidance.in_words(), doubts) == (
        "Never fly slower than 6 m/s. Never fly faster than 12 m/s, for 20 steps.",
        [],
    )


def test_a_quick_one_is_no_sensor() -> None:
    assert [number.value for number in numbers_of("quick one: one visit of sensor one, the other one too")] == [1, 1]


def test_a_list_of_visits_with_one_verb_is_for_the_llm() -> None:
    assert not phrased("Visit 1 every 5 steps, 8 every 4 and 9 at least once in ten steps.").orders


def test_one_visit_in_the_midst_of_a_sentence_is_read() -> None:
    for note in (
        "Get me one look at sensor 9 when you can, the farmer called.",
        "They smell gas, so get a drone over to sensor 9 right away, just the once.",
        "If it is not too much trouble, one of them, any of them, could drop by sensor 9 just a single time",
        "Could one of the drones check on sensor 9 just the one time? Whenever it fits.",
    ):
        guidance, _ = phrased(note).completed(NO_GUIDANCE, ())
        assert guidance.in_words() == "Visit sensor 9 once, as soon as possible."


def test_an_end_after_a_comma_belongs_to_the_order_before_it() -> None:
    note = phrased("Sensor 2 matters most, count it triple until step 20")
    guidance, doubts = note.completed(Guidance.of({"weight:2": 3}, {}), {2.0, 3.0})
    assert (guidance.in_words(), doubts) == ("Count each packet that sensor 2 loses 3 times, until step 20.", [])


def test_no_need_for_a_sensor_whose_visits_are_ordered_ends_them_alone() -> None:
    note = phrased("Visit sensor 5 every 5 steps; no need to bother with sensor 4 any more.")
    guidance, doubts = note.completed(Guidance.of({"weight:4": 0}, {}), {4.0})
    assert (guidance.in_words(), doubts) == ("Visit sensor 5 at least once in every 5 steps.", [])
    assert note.withdrawn == ["visit:4"]


def test_a_note_in_another_language_is_known() -> None:
    for note in (
        "Bitte alle 5 Schritte an Sensor 6 vorbeifliegen, dort haben wir einen Druckabfall.",
        "Ne dépassez pas 5 m/s et visitez sensor 3 toutes les 3 étapes.",
        "Por favor visite el sensor 4 cada 3 pasos.",
    ):
        assert phrased(note).is_foreign
    assert not phrased("Visit sensor 4 every 3 steps, and never fly over 9 m/s.").is_foreign


def test_what_is_refused_leaves_the_rest() -> None:
    note = phrased("The 9 m/s cap is off, but sensor 4 every 3 steps.")
    kept = Guidance(sensors=READ.sensors)
    assert note.completed(READ, {3.0, 4.0, 9.0}) == (kept, ["In no order: “the 9 m/s cap is off”."])


@pytest.mark.parametrize(
    ("note", "read", "in_no_order"),
    [
        # No words here ask to ignore every sensor, and no number is a weight.
        ("the crew was at 3", {f"weight:{j}": 0 for j in range(10)}, "the crew was at 3"),
        (
            "5 and 8 need a visit at least every 6 steps",
            {"visit:5": 6, "visit:8": 6, "weight:5": 8},
            "5 8 need a visit",
        ),
        ("5 is repaired, we don't need to check it", {"weight:5": 0}, "5 is repaired"),
        ("the cap is gone, and keep moving", {"avoid:0": 0}, "the cap is gone"),
        ("sensor 7 has new readings; somebody should stop by 5", {"weight:7": 5}, "sensor 7 has new readings"),
        ("scrap what I asked for except the survey on 0 and 9", {"weight:0": 0, "weight:9": 0}, "scrap what i asked"),
    ],
)
def test_what_no_word_asks_for_is_in_no_order(note: str, read: dict[str, float], in_no_order: str) -> None:
    found = phrased(note)
    try:
        guidance, doubts = found.completed(Guidance.of(read, {}), {3.0, 5.0, 6.0, 8.0})
    except BadOrders as refused:
        assert f"“{in_no_order}" in str(refused)
    else:
        assert guidance.values == {name: value for name, value in read.items() if not name.startswith("weight")}
        assert any(doubt.startswith(f"In no order: “{in_no_order}") for doubt in doubts)


def test_all_sensors_but_some_may_be_ignored() -> None:
    read = Guidance.of({"weight:0": 2, **{f"weight:{j}": 0 for j in range(1, 10)}}, {})
    for note in ("sensor 0 counts twice, ignore the rest", "sensor 0 counts twice, forget all others"):
        assert phrased(note).completed(read, {0.0})[0] == read


@pytest.mark.parametrize(
    ("note", "words"),
    [
        ("{} and stay below 9 m/s until step 40", f"{VISIT}. Never fly faster than 9 m/s, until step 40."),
        ("{} until step 40 and stay below 9 m/s", f"{VISIT}, until step 40. Never fly faster than 9 m/s."),
        ("{}, but only 9 m/s for the next 4 steps", f"{VISIT}. Never fly faster than 9 m/s, for 4 steps."),
        (
            "For the next 4 steps {}, stay below 9 m/s",
            f"{VISIT}, for 4 steps. Never fly faster than 9 m/s, for 4 steps.",
        ),
    ],
)
def test_an_end_is_that_of_its_own_words(note: str, words: str) -> None:
    guidance, doubts = phrased(note.format("sensor 4 every 3 steps")).completed(READ, {3.0, 4.0, 9.0})
    assert (guidance.in_words(), doubts) == (words, [])


@pytest.mark.parametrize(
    ("note", "reasons"),
    [
        ("UAV 2 should fly at most 8 m/s", ["An order is for every UAV, and none for “uav 2” alone."]),
        ("Drone #1: visit sensor 4 every 3 steps", ["An order is for every UAV, and none for “drone #1” alone."]),
        ("Stay above 50 m near sensor 3", ["No order is about heights: “above 50 m”."]),
        ("altitude at least 40 metres", ["No order is about heights: “altitude”."]),
        ("From step 20 on, ignore 3", ["An order begins with its confirmation, and not “from step 20 on”."]),
        ("Slow down to 5 m/s tomorrow", ["An order begins with its confirmation, and not “tomorrow”."]),
        (
            "Scrap all except visit 4.",
            ["No order has an exception: “except visit 4”; where a withdrawal has one, withdraw order by order."],
        ),
        ("If it rains, slow down to 5 m/s", ["No order has a condition: “if it rains”."]),
        ("Visit sensor 8 every 3 steps. Forget it.", ["The note may take back what it says: “forget it”."]),
        ("fly at 12 m/s, at least 5 m/s, above 9 mph until step 20", []),
        ("If nobody was at sensor 4 for six steps, go there.", []),
        ("visit sensor 4 for the next 5 steps as often as you can if you like", []),
    ],
)
def test_what_no_order_can_say_has_its_reason(note: str, reasons: list[str]) -> None:
    assert phrased(note).unsaid == reasons


@pytest.mark.parametrize("words", ["every couple of steps", "once every couple of steps", "every 2 steps"])
def test_a_couple_is_two(words: str) -> None:
    note = phrased(f"Visit sensor 4 {words}.")
    assert note.is_read
    assert note.completed(NO_GUIDANCE, ()) == (Guidance.of({"visit:4": 2}, {}), [])


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
        both, doubts = found.completed(READ, {3.0, 4.0, 9.0})
        # An order that the LLM has read is there, replaced by code's own reading, withdrawn or quoted.
        # The LLM is not asked about a note that code reads whole.
        assert found.is_read or doubts or {*both.values, *found.withdrawn} >= READ.values.keys()
    except (BadOrders, Impossible, ValueError):
        return
    assert len(found.rest) == len(note.lower()) and isinstance(guidance, Guidance)


@pytest.mark.parametrize("until", ["for the next 300 hours", "until step 123456789012", "for 200000 steps"])
def test_an_end_beyond_all_steps_is_none_and_a_doubt(until: str) -> None:
    found = phrased(f"Fly at most 9 m/s {until}.")
    try:
        orders, doubts = found.completed(NO_GUIDANCE, ())
    except BadOrders:
        return
    assert [*doubts, *found.unsaid], orders
