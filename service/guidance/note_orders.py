"""Orders: the fixed form in which an LLM puts an operator's note, how a server is held to it, and how it is read.

An order is a few words with numbers in them, and a note becomes some orders with commas between them, or ``nothing``.
Every number must occur in the note, as digits or as a word, and no two orders may use the same one: an LLM that makes
things up is found out by its numbers.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from functools import cache, lru_cache

from pydantic import ValidationError

from service.guidance.order_examples import EXAMPLES
from shared.guidance import Guidance, SensorWish

INSTRUCTION = "Rewrite the operator's note as orders for the UAVs."
NOTHING = "nothing"
SEPARATOR = ", "
MOST_ORDERS = 6
# The most alike of the examples, the nearest last. A model of 135M parameters gets 22 of 30 held-out notes right with
# them, where the nearest example's orders with this note's numbers are right 17 times (benchmarks/notes.py).
_SHOWN = 8

VISIT, WEIGHT = "visit sensor # every # steps", "sensor # counts # times"
FASTEST, SLOWEST, FORBIDDEN = "fly at most # m/s", "fly at least # m/s", "do not fly at # m/s"
_PATTERNS = {
    words: re.compile(re.escape(words).replace(r"\#", "([0-9]{1,4})"))
    for words in (VISIT, WEIGHT, FASTEST, SLOWEST, FORBIDDEN)
}

# fmt: off
_CARDINALS = [
    "zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
    "thirteen", "fourteen",
]
_ORDINALS = [
    "zeroth", "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth",
    "eleventh", "twelfth",
]
# fmt: on
_NUMBER_WORDS = {word: value for words in (_CARDINALS, _ORDINALS) for value, word in enumerate(words)}
# "Every other step" is every second one; what is ignored or left out counts 0 times.
_NUMBER_WORDS |= {"twice": 2, "double": 2, "other": 2, "triple": 3, "ignore": 0, "ignored": 0, "leave": 0}
_TOKEN = re.compile(r"[0-9]+|[a-z]+|m/s|:")


class BadOrders(ValueError):
    """Orders that do not stand up to the note; the message says why."""


def numbers_in(note: str) -> Counter[int]:
    """The numbers that a note names, as digits or in words, and how often."""
    named = [number_of(token) for token in _TOKEN.findall(note.lower())]
    return Counter(number for number in named if number is not None)


def read(text: str, note: str) -> Guidance:
    """The structure that orders are, from plain text or the JSON object of ``constrain_orders``.

    Raises:
        BadOrders: extra text, an order given twice, or a number that the note does not name, or not so often.
    """
    wishes: dict[int, dict[str, int]] = {}
    limits: dict[str, int] = {}
    forbidden: list[int] = []
    for words, numbers in map(parsed, _listed(text)):
        if words in (VISIT, WEIGHT):
            told, key, value = (
                wishes.setdefault(numbers[0], {}),
                "visit_every" if words == VISIT else "weight",
                numbers[1],
            )
        elif words == FORBIDDEN:
            forbidden.append(numbers[0])
            continue
        else:
            told, key, value = limits, "max_velocity" if words == FASTEST else "min_velocity", numbers[0]
        if key in told:
            raise BadOrders(f"{key} is ordered twice")
        told[key] = value
    used = Counter([*wishes, *forbidden, *limits.values(), *(v for wish in wishes.values() for v in wish.values())])
    if made_up := used - numbers_in(note):
        raise BadOrders(
            f"the orders use the number {next(iter(made_up))}, which the note does not name, or not so often"
        )
    try:
        sensors = [SensorWish.model_validate({"sensor_id": sensor, **wish}) for sensor, wish in wishes.items()]
        return Guidance.model_validate({"sensors": sensors, **limits, "forbidden_velocities": forbidden})
    except ValidationError as error:
        first = error.errors()[0]
        raise BadOrders(f"{first['loc'][-1] if first['loc'] else 'orders'}: {first['msg']}") from None


def shown(note: str, count: int = _SHOWN) -> list[tuple[str, str]]:
    """The worked examples most like a note, the nearest last: notes and their orders.

    Likeness is the cosine of the words and pairs of words that occur in both, rare ones counting more (tf-idf).
    """
    likeness = [_likeness(_features(note), _features(example)) for example, _ in EXAMPLES]
    order = sorted(range(len(EXAMPLES)), key=lambda i: likeness[i])
    return [EXAMPLES[i] for i in order[-count:]]


def number_of(token: str) -> int | None:
    """The number that a word or digits name."""
    return int(token[:6]) if token.isdigit() else _NUMBER_WORDS.get(token)


def parsed(order: str) -> tuple[str, list[int]]:
    """Which order it is, and its numbers; raises ``BadOrders`` for what is none."""
    for words, pattern in _PATTERNS.items():
        if found := pattern.fullmatch(order):
            return words, [int(number) for number in found.groups()]
    raise BadOrders(f"{order[:80]!r} is no order")


def _listed(text: str) -> list[str]:
    stripped = text.strip()
    if stripped.startswith("{"):
        try:
            orders = json.loads(stripped)["orders"]
        except (ValueError, KeyError, RecursionError):
            raise BadOrders(f"{text[:80]!r} is not what was asked for") from None
        if not isinstance(orders, list) or not all(isinstance(order, str) for order in orders):
            raise BadOrders(f"{text[:80]!r} is not what was asked for")
        return orders[:MOST_ORDERS]
    return [] if stripped == NOTHING else stripped.split(SEPARATOR)[:MOST_ORDERS]


@lru_cache(maxsize=256)
def _features(note: str) -> frozenset[str]:
    """Words and pairs of words, every number alike."""
    tokens = ["#" if number_of(token) is not None else token for token in _TOKEN.findall(note.lower())]
    return frozenset(tokens) | {" ".join(pair) for pair in zip(tokens, tokens[1:], strict=False)}


@cache
def _rarity() -> dict[str, float]:
    seen = Counter(feature for example, _ in EXAMPLES for feature in _features(example))
    return {feature: math.log(1 + len(EXAMPLES) / count) for feature, count in seen.items()}


def _likeness(first: frozenset[str], second: frozenset[str]) -> float:
    def total(features: frozenset[str]) -> float:
        return sum(_rarity().get(feature, math.log(1 + len(EXAMPLES))) for feature in features)

    return total(first & second) / math.sqrt(max(total(first) * total(second), 1e-9))
