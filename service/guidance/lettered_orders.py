"""The language in which the orders' adapter answers, and its meaning.

The adapter reads a note whose numbers are letters (:mod:`service.guidance.note_numbers`) and writes orders of the same
letters, such as ``visit A B every C; max D``. Code reads the letters' values and units here, and checks them.
A change of a word here, or of the letters' text, is another version: :data:`service.llm.adapter_version.ORDERS`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from service.guidance.note_numbers import LetteredNote, Number
from service.guidance.note_orders import BadOrders
from shared.planning.orders import End, Guidance, Impossible
from shared.world.scenario import Scenario

STATIC = "Orders of a note."
SEPARATOR = "; "
NOTHING, UNCLEAR, MOVE, ALL, OTHERS = "nothing", "unclear", "move", "all", "others"
PARTLY = "A part of the note is unclear, and is in no order"
_MOST_ORDERS = 8
METRES_A_SECOND = {None: 1.0, "m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 0.514444}
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}
# A converted velocity this near to a whole number is that number.
ROUNDING = 0.05


@dataclass(frozen=True, slots=True)
class NoteReading:
    """What a note was read as.

    Attributes:
        doubts: sentences about what may be wrong; empty if nothing is known to be.
        numbers: the numbers of the note that the orders use.
    """

    guidance: Guidance
    doubts: tuple[str, ...] = ()
    numbers: frozenset[float] = frozenset()


def grammar(note: LetteredNote) -> str:
    """GBNF of the answers that a note's letters allow."""
    if not note.numbers:
        return f'root ::= "{NOTHING}" | "{UNCLEAR}" | "{MOVE}"'
    letter = " | ".join(f'"{one}"' for one in note.numbers)
    return "\n".join(
        (
            f'root ::= "{NOTHING}" | "{UNCLEAR}" | '
            f'order ("{SEPARATOR}" order){{0,{_MOST_ORDERS - 1}}} ("{SEPARATOR}{UNCLEAR}")?',
            f'order ::= "visit " who (" every " n | " always") | "weigh " who " " n | "ignore " (who | "{OTHERS}") | '
            f'"max " n | "min " n | "avoid " n (" " n)* | "{MOVE}" | "until " n | "for " n',
            f'who ::= "{ALL}" | n ("-" n | (" " n)*)',
            f"n ::= {letter}",
        )
    )


def meaning(answer: str, note: LetteredNote, scenario: Scenario) -> NoteReading:
    """The reading of an answer.

    Raises:
        BadOrders: the answer is none, is unclear, or a number cannot be what it is ordered to be.
    """
    words = answer.strip()
    if words == UNCLEAR:
        raise BadOrders("the note is unclear: say which sensor, how often, or how fast")
    orders = _Orders(note.numbers, scenario)
    if words != NOTHING:
        for order in words.split(SEPARATOR):
            orders.add(order)
    return NoteReading(orders.guidance(), tuple(orders.doubts), frozenset(orders.used))


class _Orders:
    """The orders of one answer."""

    def __init__(self, numbers: Mapping[str, Number], scenario: Scenario) -> None:
        self._numbers = numbers
        self._scenario = scenario
        self._values: dict[str, float] = {}
        self._end: End | None = None
        self._others = False
        self.doubts: list[str] = []
        self.used: set[float] = set()

    def add(self, order: str) -> None:
        """Add one order; raises :class:`BadOrders`."""
        kind, *words = order.split(" ")
        writers: dict[str, Callable[[list[str]], object]] = {
            "visit": self._visit,
            "weigh": lambda words: self._wish("weight", words[:-1], self._plain(words[-1], "weight")),
            "ignore": self._ignore,
            "max": lambda words: self._order("max_velocity", self._velocity(words, math.floor)),
            "min": lambda words: self._order("min_velocity", self._velocity(words, math.ceil)),
            "avoid": self._avoid,
            MOVE: lambda _: self._order("avoid:0", 0),
            "until": self._until,
            "for": lambda words: self._ended(End(steps=self._period(words[0]))),
            UNCLEAR: lambda _: self.doubts.append(PARTLY),
        }
        write = writers.get(kind)
        if write is None or (not words and kind not in (MOVE, UNCLEAR)):
            raise BadOrders(f"{order[:80]!r} is no order")
        if len({*words}) < len(words):
            raise BadOrders("a number is twice in an order")
        write(words)

    def guidance(self) -> Guidance:
        """The orders together; raises :class:`BadOrders`."""
        if self._others:
            for sensor in range(self._scenario.sensors):
                if not {f"visit:{sensor}", f"weight:{sensor}"} & self._values.keys():
                    self._values[f"weight:{sensor}"] = 0.0
        ends = {} if self._end is None else dict.fromkeys(self._values, self._end)
        try:
            return Guidance.of(self._values, ends)
        except Impossible as error:
            raise BadOrders(str(error)) from None

    def _visit(self, words: list[str]) -> None:
        if words[-1] == "always":
            return self._wish("visit", words[:-1], 1)
        if len(words) < 3 or words[-2] != "every":
            raise BadOrders("a visit has no period")
        return self._wish("visit", words[:-2], self._period(words[-1]))

    def _ignore(self, words: list[str]) -> None:
        if words == [OTHERS]:
            self._others = True
        else:
            self._wish("weight", words, 0.0)

    def _avoid(self, words: list[str]) -> None:
        for word in words:
            level = self._velocity([word], _whole)
            self._order(f"avoid:{level}", level)

    def _until(self, words: list[str]) -> None:
        number = self._number(words[0])
        if number.unit not in (None, "steps") or not number.value.is_integer():
            raise BadOrders(f"{number.value:g} {number.unit or ''} is no step")
        self._ended(End(step=int(number.value)))

    def _ended(self, end: End) -> None:
        if self._end is not None:
            raise BadOrders("the orders end twice")
        self._end = end

    def _wish(self, kind: str, sensors: list[str], value: float) -> None:
        for sensor in self._sensors(sensors):
            self._order(f"{kind}:{sensor}", value)

    def _order(self, name: str, value: float) -> None:
        if self._values.setdefault(name, value) != value:
            raise BadOrders(f"{name} is ordered twice")

    def _sensors(self, words: list[str]) -> list[int]:
        if not words:
            raise BadOrders("an order names no sensor")
        if words == [ALL]:
            return list(range(self._scenario.sensors))
        sensors: list[int] = []
        for word in words:
            first, last = self._sensor(word.split("-")[0]), self._sensor(word.split("-")[-1])
            if not first + ("-" in word) <= last < first + self._scenario.sensors:
                raise BadOrders(f"sensors {first} to {last} are no range")
            sensors += range(first, last + 1)
        return sensors

    def _sensor(self, letter: str) -> int:
        value = self._plain(letter, "sensor")
        if not value.is_integer():
            raise BadOrders(f"there is no sensor {value:g}")
        return int(value)

    def _number(self, letter: str) -> Number:
        if letter not in self._numbers:
            raise BadOrders(f"{letter[:20]!r} is no number of the note")
        self.used.add(self._numbers[letter].value)
        return self._numbers[letter]

    def _plain(self, letter: str, what: str) -> float:
        number = self._number(letter)
        if number.unit == "%" and what == "weight":
            return number.value / 100
        if number.unit is not None or (number.is_ordinal and what == "weight"):
            raise BadOrders(f"a {what} of {number.value:g}{'th' if number.unit is None else f' {number.unit}'}")
        return number.value

    def _period(self, letter: str) -> int:
        """Steps; a time is rounded down to whole steps."""
        number = self._number(letter)
        if number.unit in SECONDS:
            steps = number.value * SECONDS[number.unit] / self._scenario.step_s
        elif number.unit in (None, "steps") and number.value.is_integer():
            steps = number.value
        else:
            raise BadOrders(f"{number.value:g} {number.unit or 'steps'} are no period")
        if steps < 1:
            raise BadOrders(f"{number.value:g} {number.unit} are shorter than a step of {self._scenario.step_s:g} s")
        return int(steps)

    def _velocity(self, words: list[str], rounded: Callable[[float], int]) -> int:
        number = self._number(words[0]) if len(words) == 1 else None
        if number is None or number.unit not in METRES_A_SECOND:
            raise BadOrders("a velocity has no number in m/s, km/h, mph or knots")
        value = number.value * METRES_A_SECOND[number.unit]
        level = round(value) if abs(value - round(value)) <= ROUNDING else rounded(value)
        if level > self._scenario.max_velocity:
            raise BadOrders(f"{level} m/s is above the fleet's top speed, {self._scenario.max_velocity} m/s")
        return level


def _whole(value: float) -> int:
    raise BadOrders(f"{value:.1f} m/s is none of the velocities")
