"""The rules' reading of notes: what they read, and that they read nothing where a word or a number is not plain."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.guidance.plain_reading import plain_reading
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]


@pytest.mark.parametrize(
    ("note", "values"),
    [
        ("Have sensors 1 and 8 looked after every 6 steps.", {"visit:1": 6, "visit:8": 6}),
        ("Eyes on sensors 6 through 8 at least once a minute.", {"visit:6": 6, "visit:7": 6, "visit:8": 6}),
        ("Sensor 9 matters 5 times as much and must be emptied every 6 steps.", {"weight:9": 5, "visit:9": 6}),
        ("Go round by sensor 0 every 7 steps, by sensor 5 every 9.", {"visit:0": 7, "visit:5": 9}),
        ("Every other step to sensor 2, and every 3 steps to sensor 4.", {"visit:2": 2, "visit:4": 3}),
        ("For me sensor 2 is worth three times as much as the others.", {"weight:2": 3}),
        ("Sensor 6 should weigh in double; sensor 3 is dead, so skip it.", {"weight:6": 2, "weight:3": 0}),
        ("Sensor 2 gets company in every single step.", {"visit:2": 1}),
        ("All sensors want a flyover each 8 steps.", {f"visit:{sensor}": 8 for sensor in range(10)}),
        ("At least 3 m/s, please, and sensor 8 gets weight 4.", {"min_velocity": 3, "weight:8": 4}),
        ("Gusts, so nobody goes quicker than 54 km/h.", {"max_velocity": 15}),
        ("Cap: 13 m/s.", {"max_velocity": 13}),
        ("Window for the speed: no less than 5, no more than 12 m/s.", {"min_velocity": 5, "max_velocity": 12}),
        ("Let them fly between 3 and 10 m/s.", {"min_velocity": 3, "max_velocity": 10}),
        ("Avoid 3 m/s and 11 m/s, both make the gimbal wobble.", {"avoid:3": 3, "avoid:11": 11}),
        ("The rotors sing at 8 m/s, so choose any other speed.", {"avoid:8": 8}),
        ("No hovering, gentlemen.", {"avoid:0": 0}),
    ],
)
def test_plain_notes_are_read(note: str, values: dict[str, float]) -> None:
    assert plain_reading(note, PAPER) == values


@pytest.mark.parametrize(
    "note",
    [
        "Sensor 4 was visited every 3 steps.",
        "Visit sensor 4 every 3 steps if the queue is long.",
        "Visit sensor 4 or sensor 5 every 3 steps.",
        "UAV 1 looks after sensor 6 every 3 steps.",
        "Sensor 4 at most as often as every 5 steps.",
        "Stay over sensor 4 for 5 minutes.",
        "Sensor 4 every 3 steps, the rest gets no visits.",
        "The site is 2 km long, sensor 4 every 3 steps.",
        "Sensor 4 every 3 steps, and there are 4 seats left.",
        "Sensor 5 matters. Visit sensor 4 every 3 steps.",
        "Every 4 steps would do.",
        "Sensor 4 every 3 steps, sensor 4 every 5 steps.",
        "The speed is 8 m/s.",
        "Never above 8 m/s or below 3.5 m/s.",
        "Sensor 4 every 5 seconds.",
        "Fine work, everyone.",
        "Ignore it.",
        "Half the sheep drink by sensor 0, so see it every fifteen steps.",
        "Visit sensor 4 twice every 10 steps.",
        "Weight 8 for sensor 3 and 10 for sensor 9.",
        "",
    ],
)
def test_what_is_not_plain_is_not_read(note: str) -> None:
    assert plain_reading(note, PAPER) is None


def test_a_range_of_any_length_is_read_as_far_as_a_mission_may_have_sensors() -> None:
    found = plain_reading("Sensors 3 to 999999999 every 4 steps.", PAPER)
    assert found is not None and len(found) < 2100


@given(st.text(alphabet=st.sampled_from("sensor 4 every 3 steps m/s at most-,.;no"), max_size=80))
def test_any_text_is_read_or_not(note: str) -> None:
    found = plain_reading(note, PAPER)
    assert found is None or found
