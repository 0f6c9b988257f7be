"""Orders: the fixed form in which an LLM rewrites an operator's note, its constraint for a server, and the parser.

An order is a phrase with numbers. A note becomes a list of orders separated by commas, or ``nothing``. Every number of
an order must occur in the note, as digits or as a word, and two orders may not use the same occurrence. This check
detects an LLM that invents an order.
"""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any

from service.guidance.note_numbers import CARDINALS, ORDINALS
from service.llm.request_bodies import Constraint
from shared.planning.orders import Guidance

# Worked examples: notes as operators write them, and their orders.
EXAMPLES: list[tuple[str, str]] = list(
    json.loads(files("service.guidance").joinpath("order_examples.json").read_text(encoding="utf-8")).items()
)
INSTRUCTION = "Rewrite the operator's note as orders for the UAVs."
NOTHING = "nothing"
SEPARATOR = ", "
MOST_ORDERS = 6
_MOST_NUMBERS = 10
# The examples in the prompt. With 8 of them a model of 135M parameters compiles 22 of 30 held-out notes correctly. The
# orders of the most similar example with the note's numbers are correct for 17 (lab/benchmarks/notes.py).
_EXAMPLES_SHOWN = 8

VISIT, WEIGHT = "visit sensor # every # steps", "sensor # counts # times"
FASTEST, SLOWEST, FORBIDDEN = "fly at most # m/s", "fly at least # m/s", "do not fly at # m/s"
_FORMS = ("visit:{}", "weight:{}", "max_velocity", "min_velocity", "avoid:{}")
_NAMES = dict(zip((VISIT, WEIGHT, FASTEST, SLOWEST, FORBIDDEN), _FORMS, strict=True))
_PATTERNS = {words: re.compile(re.escape(words).replace(r"\#", "([0-9]{1,4})")) for words in _NAMES}

_NUMBER_WORDS = {word: value for words in (CARDINALS[:15], ORDINALS[:13]) for value, word in enumerate(words)}
# "Every other step" is every second step. An ignored sensor, or one that is left out, counts 0 times.
_NUMBER_WORDS |= {"twice": 2, "double": 2, "other": 2, "triple": 3, "ignore": 0, "ignored": 0, "leave": 0}
_NUMBER_WORDS |= {"couple": 2, "dozen": 12}
_TOKEN = re.compile(r"[0-9]+|[a-z]+|m/s|:")


class BadOrders(ValueError):
    """Orders that do not match the note; the message gives the reason."""


def numbers_in(note: str) -> Counter[int]:
    """How often each number occurs in a note, as digits or in words."""
    named = [number_of(token) for token in _TOKEN.findall(note.lower())]
    return Counter(number for number in named if number is not None)


def parse_orders(text: str, note: str) -> Guidance:
    """The guidance that the orders describe, from plain text or the JSON object of ``constrain_orders``.

    Raises:
        BadOrders: extra text, a repeated order, or a number that occurs more often than in the note.
        Impossible: a number is out of range.
    """
    values: dict[str, float] = {}
    sensors: set[int] = set()
    for words, numbers in map(_parsed, _orders_in(text)):
        name = _NAMES[words].format(numbers[0])
        if name in values:
            raise BadOrders(f"{name} is ordered twice")
        values[name] = numbers[-1]
        sensors |= set(numbers[:-1])
    used = Counter([*sensors, *map(int, values.values())])
    if invented := used - numbers_in(note):
        raise BadOrders(f"the orders use the number {next(iter(invented))} more often than the note")
    return Guidance.of(values, {})


def admissible(note: str) -> list[str]:
    """Every order whose numbers occur in the note, each at most as often as there; ordered by phrase.

    Raises:
        BadOrders: the note has no number, or too many different ones.
    """
    available = numbers_in(note)
    numbers = list(available)
    if not numbers:
        raise BadOrders("the note has no number, and every order needs one: only the prompt contains the note")
    if len(numbers) > _MOST_NUMBERS:
        raise BadOrders(f"the note has more than {_MOST_NUMBERS} different numbers")
    single = [_filled(words, (number,)) for words in (FASTEST, SLOWEST, FORBIDDEN) for number in numbers]
    pairs = [(first, second) for first in numbers for second in numbers if first != second or available[first] > 1]
    return [_filled(words, pair) for words in (VISIT, WEIGHT) for pair in pairs] + single


def constrain_orders(constraint: Constraint, note: str) -> dict[str, Any]:
    """The request fields that constrain a server to orders that the note's numbers allow, or ``nothing``.

    They allow orders that use a number more often than the note; ``parse_orders`` refuses these.

    Raises:
        BadOrders: as :func:`admissible`.
    """
    orders = admissible(note)
    if constraint == "grammar":
        several = f'order ("{SEPARATOR}" order){{0,{MOST_ORDERS - 1}}}'
        any_order = " | ".join(f'"{order}"' for order in orders)
        return {"grammar": f'root ::= "{NOTHING}" | {several}\norder ::= {any_order}'}
    if constraint == "structured_outputs":
        one = f"({'|'.join(map(re.escape, orders))})"
        return {"structured_outputs": {"regex": f"({NOTHING}|{one}({SEPARATOR}{one}){{0,{MOST_ORDERS - 1}}})"}}
    if constraint == "json_schema":
        listed = {"orders": {"type": "array", "items": {"type": "string", "enum": orders}}}
        schema = {"type": "object", "properties": listed, "required": ["orders"], "additionalProperties": False}
        named = {"name": "orders", "strict": True, "schema": schema}
        return {"response_format": {"type": "json_schema", "json_schema": named}}
    return {}


def similar_examples(note: str, count: int = _EXAMPLES_SHOWN) -> list[tuple[str, str]]:
    """The worked examples most similar to a note, the most similar last: notes and their orders.

    Similarity is the cosine of the tf-idf weights of words and pairs of words.
    """
    similarity = [_similarity(_features(note), _features(example)) for example, _ in EXAMPLES]
    return [EXAMPLES[i] for i in sorted(range(len(EXAMPLES)), key=lambda i: similarity[i])[-count:]]


def number_of(token: str) -> int | None:
    """The value of digits or of a number word; None for any other token."""
    return int(token[:6]) if token.isdigit() else _NUMBER_WORDS.get(token)


def _parsed(order: str) -> tuple[str, list[int]]:
    """The order's phrase and its numbers; raises ``BadOrders`` for other text."""
    for words, pattern in _PATTERNS.items():
        if found := pattern.fullmatch(order):
            return words, [int(number) for number in found.groups()]
    raise BadOrders(f"{order[:80]!r} is no order")


def _filled(words: str, numbers: Sequence[int]) -> str:
    for number in numbers:
        words = words.replace("#", str(number), 1)
    return words


def _orders_in(text: str) -> list[str]:
    stripped = text.strip()
    if stripped.startswith("{"):
        try:
            orders = json.loads(stripped)["orders"]
            if not isinstance(orders, list) or not all(isinstance(order, str) for order in orders):
                raise ValueError("no list of texts")
        except (ValueError, KeyError, RecursionError):
            raise BadOrders(f"{text[:80]!r} is not a JSON object with a list of orders") from None
        return orders[:MOST_ORDERS]
    return [] if stripped == NOTHING else stripped.split(SEPARATOR)[:MOST_ORDERS]


@lru_cache(maxsize=256)
def _features(note: str) -> frozenset[str]:
    """Words and pairs of words; every number is the same word."""
    tokens = ["#" if number_of(token) is not None else token for token in _TOKEN.findall(note.lower())]
    return frozenset(tokens) | {" ".join(pair) for pair in itertools.pairwise(tokens)}


@cache
def _rarity() -> dict[str, float]:
    counts = Counter(feature for example, _ in EXAMPLES for feature in _features(example))
    return {feature: math.log(1 + len(EXAMPLES) / count) for feature, count in counts.items()}


def _similarity(first: frozenset[str], second: frozenset[str]) -> float:
    def total(features: frozenset[str]) -> float:
        return sum(_rarity().get(feature, math.log(1 + len(EXAMPLES))) for feature in features)

    return total(first & second) / math.sqrt(max(total(first) * total(second), 1e-9))
