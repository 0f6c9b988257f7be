"""The orders that a note's numbers allow, as a constraint for the LLM server: GBNF, a regular expression or JSON."""

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
    parse_order,
)
from service.llm.request_bodies import Constraint

_MOST_NUMBERS = 10
_MOST_RULES = 60


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


def _grammar(orders: Sequence[str], available: Counter[int]) -> str:
    """GBNF in which no number is used more often than it is available, as ``parse_orders`` requires.

    Each rule is a state: the numbers that are left and the sensors that are already named. A breadth-first search finds
    the states. If a note has too many numbers for a limited number of rules, a fixed grammar allows more orders, and
    ``parse_orders`` refuses the wrong ones.
    """
    start = _GrammarState(frozenset(available.items()))
    index = {start: 0}
    queue, rules = [start], []
    # The loop extends the list that it iterates over.
    for state in queue:
        by_next: dict[_GrammarState, list[str]] = {}
        for order in orders:
            if (after := state.after(order)) is not None:
                by_next.setdefault(after, []).append(f'"{order}"')
        for after in by_next:
            if after not in index and any(after.after(order) is not None for order in orders):
                index[after] = len(index)
                queue.append(after)
        if len(index) > _MOST_RULES:
            any_order = " | ".join(f'"{order}"' for order in orders)
            several = f'order ("{SEPARATOR}" order){{0,{MOST_ORDERS - 1}}}'
            return f'root ::= "{NOTHING}" | {several}\norder ::= {any_order}'
        alternatives = [
            f"({' | '.join(quoted)})" + (f' ("{SEPARATOR}" s{index[after]})?' if after in index else "")
            for after, quoted in by_next.items()
        ]
        rules.append(f"s{index[state]} ::= {' | '.join(alternatives)}")
    return "\n".join([f'root ::= "{NOTHING}" | s0', *rules])


@dataclass(frozen=True, slots=True)
class _GrammarState:
    """The numbers that are left, with the uses left of each, and the sensors that the orders so far name."""

    left: frozenset[tuple[int, int]]
    sensors: frozenset[int] = frozenset()

    def after(self, order: str) -> _GrammarState | None:
        """The state after one more order; None if the order uses a number too often."""
        words, numbers = parse_order(order)
        sensors = frozenset(numbers[:1]) if words in (VISIT, WEIGHT) else frozenset[int]()
        # Several orders may name the same sensor, each with another property; its number is used once.
        used = Counter(numbers) - Counter(sensors & self.sensors)
        left = Counter(dict(self.left))
        if used - left:
            return None
        return _GrammarState(frozenset((left - used).items()), self.sensors | sensors)


def _filled(words: str, numbers: Sequence[int]) -> str:
    for number in numbers:
        words = words.replace("#", str(number), 1)
    return words
