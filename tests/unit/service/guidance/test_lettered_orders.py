"""Notes whose numbers are letters, and what the orders' adapter may say of them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.guidance.lettered_orders import meaning
from service.guidance.note_numbers import LetteredNote, numbers_of
from service.guidance.note_orders import BadOrders
from shared.planning.orders import End, Guidance, Impossible, SensorWish
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]


def lettered(note: str) -> tuple[LetteredNote, dict[str, str]]:
    """The note, and the letter of each number as it is written."""
    found = LetteredNote.of(note, 3)
    lowered = note.lower()
    return found, {lowered[number.begin : number.end]: letter for letter, number in found.numbers.items()}


def test_numbers_become_letters_and_keep_what_says_more_than_a_number() -> None:
    note = "Visit S4 every third step, node 12 twice as often; not over 30km/h, 2.5x, at 10:30."
    found, letter = lettered(note)
    own = {name: letter[name] for name in ("4", "third", "12", "twice", "30", "2.5")}
    assert found.text == (
        f"visit s {own['4']} every {own['third']}th step, node {own['12']} twice {own['twice']} as often; "
        f"not over {own['30']} km/h, {own['2.5']} x, at 10:30."
    )
    assert [(number.value, number.unit) for number in found.numbers.values()] == [
        (4, None), (3, "steps"), (12, None), (2, None), (30, "km/h"), (2.5, None),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("note", "values"),
    [
        ("every other step", [2]),
        ("the other sensors, one after another", [1]),
        ("5 metres per second, 5 metres a second", [5, 5]),
        ("every second step", [2]),
        ("twenty-five seconds", [25]),
        ("sensors 3-6", [3, 6]),
        ("the 3rd", [3]),
        ("be careful", []),
        ("no longer than a minute", [1]),
        ("3 metres a second, 20 miles an hour", [3, 20]),
    ],
)
def test_number_words_are_numbers_where_they_mean_one(note: str, values: list[float]) -> None:
    assert [number.value for number in numbers_of(note)] == values


@pytest.mark.parametrize(
    ("note", "seconds"), [("a minute", 60), ("every minute", 60), ("an hour", 3600), ("half an hour", 1800)]
)
def test_a_time_without_a_number_is_one(note: str, seconds: float) -> None:
    (number,) = numbers_of(note)
    assert number.value * {"min": 60, "h": 3600}[str(number.unit)] == seconds


@given(st.text(max_size=300), st.integers(0, 5))
def test_any_note_is_read_or_refused(note: str, seed: int) -> None:
    try:
        found = LetteredNote.of(note, seed)
    except ValueError as error:
        assert "more than 20 numbers" in str(error)
        return
    assert len(set(found.numbers)) == len(found.numbers)
    assert not any(character.isdigit() and character.isascii() for character in found.text if ":" not in note)


def test_every_order_has_its_meaning() -> None:
    note = LetteredNote.of("sensors 4 5 7 every 30 seconds 2.5 times 6 m/s 36 km/h 9 steps", 0)
    a, b, c, period, weight, slow, fast, steps = note.numbers
    said = (
        f"visit {a} {b} every {steps}; visit {c} always; weigh {a}-{b} {weight}; min {slow}; max {fast}; avoid {slow}"
    )
    found = meaning(said, note, PAPER)
    assert found.doubts == ()
    assert found.guidance == Guidance(
        sensors=[
            SensorWish(sensor_id=4, visit_every=9, weight=2.5),
            SensorWish(sensor_id=5, visit_every=9, weight=2.5),
            SensorWish(sensor_id=7, visit_every=1),
        ],
        min_velocity=6,
        max_velocity=10,
        forbidden_velocities=[6],
    )
    # A step of this scenario is 10 s long.
    assert meaning(f"visit {a} every {period}", note, PAPER).guidance.sensors[0].visit_every == 3
    assert meaning("move", note, PAPER).guidance == Guidance(forbidden_velocities=[0])
    assert meaning("nothing", note, PAPER).guidance == Guidance()
    everyone = meaning(f"weigh {a} {weight}; ignore others", note, PAPER).guidance
    assert [wish.weight for wish in everyone.sensors] == [2.5] + [0.0] * (PAPER.sensors - 1)
    assert len(meaning(f"visit all every {steps}", note, PAPER).guidance.sensors) == PAPER.sensors


def test_an_end_is_that_of_every_order() -> None:
    note = LetteredNote.of("sensor 4 every 3 steps, max 8 m/s, until step 40, or for 2 minutes", 0)
    a, every, fast, step, minutes = note.numbers
    visit = f"visit {a} every {every}; max {fast}"
    assert meaning(f"{visit}; until {step}", note, PAPER).guidance.in_words() == (
        "Visit sensor 4 at least once in every 3 steps, until step 40. Never fly faster than 8 m/s, until step 40."
    )
    ends = meaning(f"{visit}; for {minutes}", note, PAPER).guidance.ends
    assert ends == {"visit:4": End(steps=12), "max_velocity": End(steps=12)}
    for wrong, why in ((f"until {minutes}", "is no step"), (f"for {fast}", "are no period")):
        with pytest.raises(BadOrders, match=why):
            meaning(f"{visit}; {wrong}", note, PAPER)
    with pytest.raises(BadOrders, match="end twice"):
        meaning(f"{visit}; until {step}; for {minutes}", note, PAPER)


def test_what_is_in_no_order_is_a_doubt() -> None:
    note = LetteredNote.of("sensor 4 every 3 steps until step 40", 0)
    found = meaning("visit {} every {}; unclear".format(*list(note.numbers)[:2]), note, PAPER)
    assert found.guidance == Guidance(sensors=[SensorWish(sensor_id=4, visit_every=3)])
    assert len(found.doubts) == 1


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("unclear", "the note is unclear"),
        ("visit {0} every {2}", "are no period"),
        ("max {1}", "no number in m/s"),
        ("weigh {0} {2}", "a weight of 9 m/s"),
        ("weigh {3} {1}", "a weight of 3 steps"),
        ("visit {4} every {1}", "there is no sensor 2.5"),
        ("visit always", "names no sensor"),
        ("visit {0} {1}", "a visit has no period"),
        ("visit {0} {3} every {3}", "twice in an order"),
        ("weigh {0} {0}", "twice in an order"),
        ("visit {0} every {1}; visit {0} every {3}", "ordered twice"),
        ("min {2}; min {3}", "ordered twice"),
        ("avoid {5}", "none of the velocities"),
        ("max {6}", "top speed"),
        ("weigh {0} {6}", "weight"),
        ("weigh {0} {7}", "a weight of 10th"),
        ("visit {0}-{0} every {1}", "are no range"),
        ("max Ω", "is no number of the note"),
        ("go home", "is no order"),
        ("visit", "is no order"),
        ("", "is no order"),
    ],
)
def test_what_a_number_cannot_be_is_refused(said: str, why: str) -> None:
    note = LetteredNote.of("sensor 4, 3 steps, 9 m/s, 7, 2.5, 20 km/h, 60, a mere tenth", 0)
    with pytest.raises((BadOrders, Impossible), match=why):
        meaning(said.format(*note.numbers), note, PAPER)
