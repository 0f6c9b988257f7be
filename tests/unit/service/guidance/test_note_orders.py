"""Orders: what an LLM may say of a note, and what is refused whatever the server promised."""

import json
import re

import pytest

from service.guidance.note_orders import (
    EXAMPLES,
    BadOrders,
    admissible,
    constrain_orders,
    numbers_in,
    parse_orders,
    similar_examples,
)
from shared.planning.orders import Guidance, Impossible, SensorWish

NOTE = "Suspected leak at sensor 4: visit it every third step, not over 9 m/s."
MEANT = Guidance(sensors=[SensorWish(sensor_id=4, visit_every=3)], max_velocity=9)
ORDERS = "visit sensor 4 every 3 steps, fly at most 9 m/s"


def test_orders_become_a_structure() -> None:
    assert parse_orders(ORDERS, NOTE) == MEANT
    assert parse_orders(json.dumps({"orders": ORDERS.split(", ")}), NOTE) == MEANT
    assert parse_orders(" nothing\n", NOTE) == Guidance()
    both = parse_orders("visit sensor 4 every 3 steps, sensor 4 counts 9 times", NOTE)
    assert both.sensors == [SensorWish(sensor_id=4, visit_every=3, weight=9)]


def test_numbers_are_found_as_digits_and_as_words() -> None:
    assert numbers_in("Sensor 12 every other step, twice as important as sensor 3") == {12: 1, 2: 2, 3: 1}
    assert numbers_in("Be careful.") == {}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("visit sensor 5 every 3 steps", "number 5 more often than the note"),
        ("visit sensor 4 every 3 steps, fly at most 3 m/s", "number 3 more often than the note"),
        ("fly at most 9 m/s, fly at most 3 m/s", "ordered twice"),
        ("visit sensor 4 every 3 steps!", "is no order"),
        ("I would visit sensor 4.", "is no order"),
        ("{", "is not a JSON object with a list of orders"),
        ('{"orders": [4]}', "is not a JSON object with a list of orders"),
        ("", "is no order"),
    ],
)
def test_what_the_note_does_not_bear_is_refused(text: str, why: str) -> None:
    with pytest.raises(BadOrders, match=re.escape(why)):
        parse_orders(text, NOTE)


def test_a_value_out_of_range_is_refused_by_name() -> None:
    with pytest.raises(Impossible, match="weight"):
        parse_orders("sensor 4 counts 60 times", "sensor 4 counts 60 times")
    with pytest.raises(Impossible, match="max_velocity"):
        parse_orders("fly at most 60 m/s", "at most 60 m/s")


def test_a_note_without_numbers_or_with_very_many_is_not_asked_about() -> None:
    with pytest.raises(BadOrders, match="has no number"):
        admissible("Be careful.")
    with pytest.raises(BadOrders, match="more than 10"):
        admissible(" ".join(map(str, range(40))))


def test_every_constraint_allows_the_right_orders_and_no_other_number() -> None:
    orders = admissible(NOTE)
    assert set(ORDERS.split(", ")) <= set(orders)
    assert {int(n) for order in orders for n in re.findall(r"[0-9]+", order)} == {3, 4, 9}
    grammar = constrain_orders("grammar", NOTE)["grammar"]
    assert all(f'"{order}"' in grammar for order in orders)
    regex = constrain_orders("structured_outputs", NOTE)["structured_outputs"]["regex"]
    assert re.fullmatch(regex, ORDERS) and re.fullmatch(regex, "nothing")
    assert not re.fullmatch(regex, "visit sensor 5 every 3 steps")
    schema = constrain_orders("json_schema", NOTE)["response_format"]["json_schema"]["schema"]
    assert schema["properties"]["orders"]["items"]["enum"] == orders
    assert constrain_orders("none", NOTE) == {}


def test_every_worked_example_stands_up_to_its_own_checks() -> None:
    for note, orders in EXAMPLES:
        understood = parse_orders(orders, note)
        assert bool(understood) == (orders != "nothing")
        if orders != "nothing":
            assert set(orders.split(", ")) <= set(admissible(note))


def test_the_examples_shown_are_the_most_alike() -> None:
    nearest, orders = similar_examples("Never use 3 m/s.")[-1]
    assert (nearest, orders) == ("Never use 12 m/s.", "do not fly at 12 m/s")
    assert len(similar_examples(NOTE)) == len(set(similar_examples(NOTE))) == 8
