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
        ("Gusty up over the roof, please don't let them go over 9 m/s.", {"max_velocity": 9}),
        ("The line worries me, so sensor 3 counts double compared to the rest.", {"weight:3": 2}),
        ("Cap: 13 m/s.", {"max_velocity": 13}),
        ("Window for the speed: no less than 5, no more than 12 m/s.", {"min_velocity": 5, "max_velocity": 12}),
        ("Let them fly between 3 and 10 m/s.", {"min_velocity": 3, "max_velocity": 10}),
        ("Avoid 3 m/s and 11 m/s, both make the gimbal wobble.", {"avoid:3": 3, "avoid:11": 11}),
        ("The rotors sing at 8 m/s, so choose any other speed.", {"avoid:8": 8}),
        ("No hovering, gentlemen.", {"avoid:0": 0}),
        ("At least 4 and 10 m/s at most.", {"min_velocity": 4, "max_velocity": 10}),
        ("Speeds max/min: 10, 4 m/s", {"min_velocity": 4, "max_velocity": 10}),
        ("Lower speed limit to 8 m/s", {"max_velocity": 8}),
        ("Ban 3 and 14 m/s.", {"avoid:3": 3, "avoid:14": 14}),
        ("The rotors whine at 7 m/s. Nobody flies at that speed.", {"avoid:7": 7}),
        ("Sensor 0 at least once per 12 steps, and top out at 11 m/s.", {"visit:0": 12, "max_velocity": 11}),
        ("Every 7 steps for sensor 6, and 8 gets half weight.", {"visit:6": 7, "weight:8": 0.5}),
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
        "Never visit sensor 4 every 3 steps.",
        "Sensor 4 need not be visited every 3 steps.",
        "Stop checking sensor 4 every 3 steps.",
        "Sensor 4 every 3 steps while the line holds pressure.",
        "Sensor 4 every 3 steps as long as the pump runs.",
        "Sensor 5 matters two thirds as much as the others.",
        "Sensor 5 counts an eighth as much as before.",
        "Half the sheep drink by sensor 0, so see it every fifteen steps.",
        "Visit sensor 4 twice every 10 steps.",
        "Weight 8 for sensor 3 and 10 for sensor 9.",
        "Everything between 7 and 9 m/s sounds vulgar; banned!",
        "Less than 2 m/s is forbidden.",
        "The limit rises from 8 to 11 m/s.",
        "Visit sensor 0.3 every 5 steps.",
        "Nae gaun at 1 m/s nor 2, she wallows.",
        "The previous shift ran sensor 4 every 3 steps.",
        "I told the ladies that you visit sensor 5 every minute.",
        "My colleague proposes 'all sensors each 20 steps'.",
        "Sensor 6 weight zero rescinded.",
        "Nice work yesterday, 7 m/s all day.",
        "Sensors six and seven: the former is dead, the latter gets a visit each 12 steps.",
        "Negative on sensor 3 every 5 steps.",
        "",
    ],
)
def test_what_is_not_plain_is_not_read(note: str) -> None:
    assert plain_reading(note, PAPER) is None


# Denials, reports, opinions, conditions, corrections, and what no UAV does.
_NO_ORDERS = """\
During the night shift the fleet never went above 8 m/s.
I am NOT asking you to ignore sensor 5.
Don't bother doubling the weight of sensor 3, it is fine as it is
Do keep them under 10 m/s, strictly under.
Personally I think sensor 0 deserves twice the weight, but it's not my call.
The inspector said "no faster than 5 m/s" and we all laughed.
Ken shouted 'skip sensor 8, it's junk!' Ken doesn't run this place. Carry on.
"Sensor 1 every 2 steps" is what day shift wrote on the board.
The old plan had sensor 4 visited every 3 steps.
Somebody proposed to visit sensor 4 every 3 steps, but I disagree.
I doubt that sensor 4 needs a look every 3 steps.
Should sensor 4 get a visit every 3 steps?
Sensor 4 gets a visit every 3 steps, right?
Sensor 4 is visited every 3 steps already.
We currently see sensor 4 every 3 steps.
Sensor 4 sends a packet every 3 steps.
The pump near sensor 4 starts every 3 steps.
Sensor 4 loses a packet every 3 steps.
Sensor 4 every 3 steps is too much.
Every 3 steps at sensor 4 is overkill.
Sensor 4 every 3 steps? No way.
Not sensor 4 every 3 steps, sensor 5 every 3 steps.
Sensor 4, no, sensor 5, every 3 steps.
Sensor 4 every 3 steps, sorry, I mean sensor 5.
Sensor 4 every 3 steps, or better every 5.
Sensor 4 weighs 3 kilos.
The value of sensor 4 is 3 today.
Sensor 4 reads 3.
Weight of sensor 4: unchanged, sensor 5: 3.
Losses at sensor 4 doubled.
Sensor 4 lost twice as many packets as sensor 5.
Data from sensor 4 is half gone.
The max speed of the old fleet was 9 m/s.
Wind is at most 9 m/s.
Gusts up to 9 m/s are expected.
The wind blows with 12 m/s at most.
Our UAVs can fly at most 15 m/s.
Don't limit them to 9 m/s.
9 m/s at most is nonsense.
Who said at most 9 m/s?
The limit is not 9 m/s but 12 m/s.
Max 9 m/s, sorry, 12 m/s.
Sensor 4 is not dead.
Sensor 4 isn't broken any more.
Sensor 4 was broken, now it works.
Nobody ignores sensor 4.
Do not leave sensor 4 out.
Why would we skip sensor 4?
I would never drop sensor 4.
Hovering is not forbidden.
It is not forbidden to hover.
They never hover anyway.
No hovering problems so far.
Sensor 4 counts three times when wet.
Sensors 4 and 5 together count three times.
Either sensor 4 every 3 steps or every 5.
Skip every third visit to sensor 4.
Visit sensor 4 every 3 steps less often.
Visit sensor 4 every 3 steps more.
Visit sensor 4 three steps later.
Visit sensor 4 3 steps after sensor 5.
All but sensor 4 every 3 steps.
Every sensor except 4 every 3 steps.
Keep 5 m/s distance from the max 9 m/s.
Two UAVs to sensor 4 every 3 steps.
Send 2 drones to sensor 4 every 3 steps.
UAV A to sensor 4 every 3 steps.
The blue drone visits sensor 4 every 3 steps.
Sensor 4 every 3 steps at night.
Sensor 4 every 3 steps after the rain.
Sensor 4 every 3 steps once the crew has left.
Photograph sensor 4 every 3 steps.
Warn me about sensor 4 every 3 steps.
Restart sensor 4 every 3 steps.
Avoid sensor 4 every 3 steps.
Keep away from sensor 4, every 3 steps is enough for sensor 5.
Slow down to 5 m/s at sensor 4.
At sensor 4 nobody flies faster than 5 m/s.
Sensor 4 needs a factor of 3 fewer visits.
Sensor 4's packets are worth nothing compared to sensor 5.
Half the fleet visits sensor 4 every 3 steps.
The instruction I gave you about sensor 2 this morning, kindly disregard it.
Please ignore the message we sent on sensor 5.
Disregard what I wrote: sensor 4.
Sensor 4 counts 20% more than normal.
Let the weight of sensor 4 be ten percent lower.
"""


@pytest.mark.parametrize("note", _NO_ORDERS.splitlines())
def test_what_only_looks_like_an_order_is_not_read(note: str) -> None:
    assert plain_reading(note, PAPER) is None


def test_a_range_of_any_length_is_read_as_far_as_a_mission_may_have_sensors() -> None:
    found = plain_reading("Sensors 3 to 999999999 every 4 steps.", PAPER)
    assert found is not None and len(found) < 2100


@given(st.text(alphabet=st.sampled_from("sensor 4 every 3 steps m/s at most-,.;no"), max_size=80))
def test_any_text_is_read_or_not(note: str) -> None:
    found = plain_reading(note, PAPER)
    assert found is None or found
