"""The fields of a phrasing: sensors, periods, factors and velocities, as operators write them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from random import Random
from typing import Any

from service.guidance.note_numbers import CARDINALS, ORDINALS

# Operators write larger numbers in digits.
_MOST_IN_WORDS = 13
_STEPS = ("steps", "steps", "steps", "steps", "steps", "time steps", "rounds")
_TIMES = (("seconds", 20, 300), ("s", 20, 300), ("minutes", 1, 10), ("min", 1, 10))
_METRES = ("m/s", "m/s", "m/s", "m/s", "metres per second", "metres a second", "meters per second", "mps")
_OTHER_SPEEDS = (("km/h", 10, 50), ("kph", 10, 50), ("mph", 6, 30), ("knots", 5, 26))
_COMPASS = ("north", "south", "east", "west")


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of a note's text; one with a key is the number of that key."""

    text: str
    key: str | None = None


Pieces = tuple[Piece, ...]


class Fields:
    """Writes the fields of a note, and keeps their forms in the orders, which have the keys of numbers in braces.

    Attributes:
        keys: by field name, the form of its last field in the orders.
        plural: whether the last sensors are several.
        last_sensors: the form of the last sensors in the orders.
        pronoun: the form of the sensor that "it" refers to.
    """

    def __init__(self, random: Random, operator: Mapping[str, Any]) -> None:
        self._random = random
        self._operator = operator
        self._used: set[int] = set()
        self._count = 0
        self.keys: dict[str, str] = {}
        self.plural = False
        self.last_sensors = self.pronoun = ""

    def write(self, name: str, before: str) -> Pieces:
        """The pieces of a field that follows the text ``before``."""
        kind, second = name[0], name.endswith("2")
        pieces, orders = getattr(self, f"_{_WRITERS[kind]}")(before)
        self.keys[("N" if kind == "O" else "W" if kind in "KD" else "V" if kind == "v" else kind) + "2" * second] = (
            orders
        )
        return tuple(pieces)

    def _number(self, text: str) -> tuple[Piece, str]:
        self._count += 1
        return Piece(text, f"k{self._count}"), f"{{k{self._count}}}"

    def _written(self, value: int, before: str, words: float = 0.25) -> str:
        """A number in digits or as a word; always in digits directly after a letter or digit."""
        in_words = value < _MOST_IN_WORDS and not before[-1:].isalnum() and self._random.random() < words
        return CARDINALS[value] if in_words else str(value)

    def _sensor_id(self) -> int:
        most = self._random.choice((10, 10, 10, 20, 60))
        free = [i for i in range(most) if i not in self._used] or [self._random.randrange(100)]
        self._used.add(chosen := self._random.choice(free))
        return chosen

    def _sensors(self, _: str) -> tuple[list[Piece], str]:
        draw = self._random.random()
        self.plural = draw > 0.8
        if draw > 0.96:
            pieces, orders = (
                [Piece(self._random.choice(("all sensors", "all of the sensors", "all the sensors")))],
                "all",
            )
        elif draw > 0.8:
            pieces, orders = self._list()
        else:
            head, _, tail = self._random.choice(self._operator["sensors"]).partition("{n}")
            number, orders = self._number(self._written(self._sensor_id(), head, 0.1))
            pieces = [Piece(head), number, Piece(tail)]
        self.last_sensors = orders
        return pieces, orders

    def _list(self) -> tuple[list[Piece], str]:
        head, _, tail = self._random.choice(self._operator["plural"]).partition("{list}")
        if self._random.random() < 0.25:
            first = self._random.randrange(0, 30)
            (one, a), (two, b) = (self._number(str(i)) for i in (first, first + self._random.randrange(2, 9)))
            dash = self._random.choice((" to ", "-", " through ", " - ", "–", " up to "))
            return [Piece(head), one, Piece(dash), two, Piece(tail)], f"{a}-{b}"
        ids = [self._sensor_id() for _ in range(self._random.choice((2, 2, 2, 3, 3, 4)))]
        last = self._random.choice((" and ", " and ", " & ", ", ", ", and "))
        pieces, keys = [Piece(head)], []
        for place, sensor in enumerate(ids):
            if place:
                pieces.append(Piece(last if place == len(ids) - 1 else ", "))
            number, key = self._number(str(sensor))
            pieces.append(number)
            keys.append(key)
        return [*pieces, Piece(tail)], " ".join(keys)

    def _it(self, _: str) -> tuple[list[Piece], str]:
        return [Piece("it")], self.pronoun

    def _period(self, before: str) -> tuple[list[Piece], str]:
        if self._random.random() < 0.12:
            unit, least, most = self._random.choice(_TIMES)
            value = self._random.randrange(least, most)
        else:
            unit, value = self._random.choice(_STEPS), self._random.choice((*range(2, 13), *range(2, 10), 15, 20))
        number, orders = self._number(self._written(value, before))
        return [number, Piece(f" {unit}")], orders

    def _ordinal(self, before: str) -> tuple[list[Piece], str]:
        value = self._random.choice((2, 2, 3, 3, 4, 5, 6, 7, 8, 9, 10, 12))
        text = ORDINALS[value]
        if value == 2 and before.endswith("every ") and self._random.random() < 0.6:
            text = self._random.choice(("other", "other", "alternate"))
        elif self._random.random() < 0.35:
            text = f"{value}{ {2: 'nd', 3: 'rd'}.get(value, 'th') }"
        number, orders = self._number(text)
        return [number, Piece(self._random.choice((" step", " step", " step", " time step", " round")))], orders

    def _weight(self, before: str) -> tuple[list[Piece], str]:
        value = self._random.choice((2, 3, 4, 5, 6, 7, 8, 9, 10, 2, 3, 4, 5))
        text = (
            self._random.choice(("1.5", "2.5", "0.5")) if self._random.random() < 0.06 else self._written(value, before)
        )
        number, orders = self._number(text)
        return [number], orders

    def _factor(self, before: str) -> tuple[list[Piece], str]:
        draw = self._random.random()
        if draw < 0.2 and not before[-1:].isalnum():
            number, orders = self._number("twice")
            return [number], orders
        if draw < 0.3:
            number, orders = self._number(str(self._random.randrange(2, 11)))
            return [number, Piece("x")], orders
        pieces, orders = self._weight(before)
        return [*pieces, Piece(" times")], orders

    def _double(self, _: str) -> tuple[list[Piece], str]:
        number, orders = self._number(self._random.choice(("double", "double", "triple", "half")))
        return [number], orders

    def _velocity(self, before: str) -> tuple[list[Piece], str]:
        pieces, orders = self._bare_velocity(before)
        draw = self._random.random()
        if draw < 0.1:
            unit, least, most = self._random.choice(_OTHER_SPEEDS)
            pieces = [Piece(str(self._random.randrange(least, most)), pieces[0].key)]
            return [*pieces, Piece(self._random.choice((" ", " ", "")) + unit)], orders
        if draw < 0.9:
            return [*pieces, Piece(f" {self._random.choice(_METRES)}")], orders
        return (pieces, orders)

    def _bare_velocity(self, before: str) -> tuple[list[Piece], str]:
        number, orders = self._number(self._written(self._random.randrange(1, 15), before, 0.12))
        return [number], orders

    def _step(self, _: str) -> tuple[list[Piece], str]:
        number, orders = self._number(str(self._random.randrange(5, 200)))
        return [number], orders


_WRITERS = {
    "S": "sensors",
    "i": "it",
    "N": "period",
    "O": "ordinal",
    "K": "factor",
    "D": "double",
    "W": "weight",
    "V": "velocity",
    "v": "bare_velocity",
    "T": "step",
}
