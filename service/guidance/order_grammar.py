"""The orders that a note's numbers allow, and how a server is held to them: by GBNF, a regular expression or JSON."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from service.guidance.note_orders import (
    FASTEST,
    FORBIDDEN,
    MOST_ORDERS,
    NOTHING,
    SEPARATOR,
    SLOWEST,
    VISIT,
    WEIGHT,
    BadOrders,
    numbers_in,
    parsed,
)
from service.llm.request_bodies import Constraint

_MOST_NUMBERS = 10
_MOST_RULES = 60


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
    one = [_filled(words, (number,)) for words in (FASTEST, SLOWEST, FORBIDDEN) for number in numbers]
    pairs = [(first, second) for first in numbers for second in numbers if first != second or named[first] > 1]
    return [_filled(words, pair) for words in (VISIT, WEIGHT) for pair in pairs] + one


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
        return {"structured_outputs": {"regex": f"({NOTHING}|{one}({SEPARATOR}{one}){{0,{MOST_ORDERS - 1}}})"}}
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
    """GBNF in which no number is used more often than it is named, as ``read`` wants it.

    A rule is what may follow, where these numbers are left and these sensors have had an order; where a note has so
    many numbers that there would be too many rules, a few fixed ones allow more, and ``read`` refuses it.
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
            several = f'order ("{SEPARATOR}" order){{0,{MOST_ORDERS - 1}}}'
            return f'root ::= "{NOTHING}" | {several}\norder ::= {words}'
        ways = [
            f"({' | '.join(told)})" + (f' ("{SEPARATOR}" s{places[after]})?' if after in places else "")
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
        words, numbers = parsed(order)
        sensors = frozenset(numbers[:1]) if words in (VISIT, WEIGHT) else frozenset[int]()
        # A sensor may be named in several orders, of which each says something else about it.
        used = Counter(numbers) - Counter(sensors & self.sensors)
        left = Counter(dict(self.left))
        if used - left:
            return None
        return _State(frozenset((left - used).items()), self.sensors | sensors)


def _filled(words: str, numbers: Sequence[int]) -> str:
    for number in numbers:
        words = words.replace("#", str(number), 1)
    return words
