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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from pydantic import ValidationError

from service.guidance.order_examples import EXAMPLES
from service.llm.answer_format import Constraint
from shared.guidance import Guidance, SensorWish

INSTRUCTION = "Rewrite the operator's note as orders for the UAVs."
NOTHING = "nothing"
_SEPARATOR = ", "
_MOST_ORDERS = 6
_MOST_NUMBERS = 10
_MOST_RULES = 60
# The most alike of the examples, the nearest last. A model of 135M parameters gets 22 of 30 held-out notes right with
# them, where the nearest example's orders with this note's numbers are right 17 times (benchmarks/notes.py).
_SHOWN = 8

_VISIT, _WEIGHT = "visit sensor # every # steps", "sensor # counts # times"
_FASTEST, _SLOWEST, _FORBIDDEN = "fly at most # m/s", "fly at least # m/s", "do not fly at # m/s"
_PATTERNS = {
    words: re.compile(re.escape(words).replace(r"\#", "([0-9]{1,4})"))
    for words in (_VISIT, _WEIGHT, _FASTEST, _SLOWEST, _FORBIDDEN)
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


def admissible(note: str) -> list[str]:
    """Every order that has only numbers of the note, none more often than the note, in the order of its words.

    Raises:
        BadOrders: the note names too many numbers, or none.
    """
    named = numbers_in(note)
    numbers = list(named)
    if not numbers:
        raise BadOrders("the note names no number, and no order goes without one: it stands in the prompt alone")
    if len(numbers) > _MOST_NUMBERS:
        raise BadOrders(f"the note names more than {_MOST_NUMBERS} different numbers")
    one = [_filled(words, (number,)) for words in (_FASTEST, _SLOWEST, _FORBIDDEN) for number in numbers]
    pairs = [(first, second) for first in numbers for second in numbers if first != second or named[first] > 1]
    return [_filled(words, pair) for words in (_VISIT, _WEIGHT) for pair in pairs] + one


def constrain_orders(constraint: Constraint, note: str) -> dict[str, Any]:
    """The request fields that hold a server to orders that the note's numbers allow, or ``nothing``.

    Raises:
        BadOrders: as :func:`admissible`.
    """
    orders = admissible(note)
    if constraint == "grammar":
        return {"grammar": _grammar(orders, numbers_in(note))}
    if constraint == "structured_outputs":
        one = f"({'|'.join(map(re.escape, orders))})"
        return {"structured_outputs": {"regex": f"({NOTHING}|{one}({_SEPARATOR}{one}){{0,{_MOST_ORDERS - 1}}})"}}
    if constraint == "json_schema":
        schema = {
            "type": "object",
            "properties": {"orders": {"type": "array", "items": {"type": "string", "enum": list(orders)}}},
            "required": ["orders"],
            "additionalProperties": False,
        }
        return {
            "response_format": {
                "type": "json_schema",
                "json_schema": {"name": "orders", "strict": True, "schema": schema},
            }
        }
    return {}


def _grammar(orders: Sequence[str], named: Counter[int]) -> str:
    """GBNF in which no number is used more often than it is named, as :func:`read` wants it.

    A rule is what may follow, where these numbers are left and these sensors have had an order; where a note has so
    many numbers that there would be too many rules, a few fixed ones allow more, and :func:`read` refuses it.
    """
    places = {_State.at_first(named): 0}
    rules = []
    for state in (waiting := list(places)):
        following: dict[_State, list[str]] = {}
        for order in orders:
            if (after := state.after(order)) is not None:
                following.setdefault(after, []).append(f'"{order}"')
        for after in following:
            if after not in places and any(after.after(order) is not None for order in orders):
                places[after] = len(places)
                waiting.append(after)
        if len(places) > _MOST_RULES:
            words = " | ".join(f'"{order}"' for order in orders)
            several = f'order ("{_SEPARATOR}" order){{0,{_MOST_ORDERS - 1}}}'
            return f'root ::= "{NOTHING}" | {several}\norder ::= {words}'
        ways = [
            f"({' | '.join(told)})" + (f' ("{_SEPARATOR}" s{places[after]})?' if after in places else "")
            for after, told in following.items()
        ]
        rules.append(f"s{places[state]} ::= {' | '.join(ways)}")
    return "\n".join([f'root ::= "{NOTHING}" | s0', *rules])


@dataclass(frozen=True, slots=True)
class _State:
    """What orders so far leave: numbers and how often they may yet be used, and the sensors named."""

    left: frozenset[tuple[int, int]]
    sensors: frozenset[int] = frozenset()

    @classmethod
    def at_first(cls, named: Counter[int]) -> _State:
        return cls(frozenset(named.items()))

    def after(self, order: str) -> _State | None:
        """What one more order leaves; None where a number would be used too often."""
        words, numbers = _parsed(order)
        sensors = frozenset(numbers[:1]) if words in (_VISIT, _WEIGHT) else frozenset[int]()
        # A sensor may be named in several orders, of which each says something else about it.
        used = Counter(numbers) - Counter(sensors & self.sensors)
        left = Counter(dict(self.left))
        if used - left:
            return None
        return _State(frozenset((left - used).items()), self.sensors | sensors)


def read(text: str, note: str) -> Guidance:
    """The structure that orders are, from plain text or the JSON object of :func:`constrain_orders`.

    Raises:
        BadOrders: extra text, an order given twice, or a number that the note does not name, or not so often.
    """
    wishes: dict[int, dict[str, int]] = {}
    limits: dict[str, int] = {}
    forbidden: list[int] = []
    for words, numbers in map(_parsed, _listed(text)):
        if words in (_VISIT, _WEIGHT):
            told, key, value = (
                wishes.setdefault(numbers[0], {}),
                "visit_every" if words == _VISIT else "weight",
                numbers[1],
            )
        elif words == _FORBIDDEN:
            forbidden.append(numbers[0])
            continue
        else:
            told, key, value = limits, "max_velocity" if words == _FASTEST else "min_velocity", numbers[0]
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


def _filled(words: str, numbers: Sequence[int]) -> str:
    for number in numbers:
        words = words.replace("#", str(number), 1)
    return words


def _parsed(order: str) -> tuple[str, list[int]]:
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
        return orders[:_MOST_ORDERS]
    return [] if stripped == NOTHING else stripped.split(_SEPARATOR)[:_MOST_ORDERS]


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
