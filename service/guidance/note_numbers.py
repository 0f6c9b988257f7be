"""The numbers of an operator's note, each replaced by a letter: the note as the orders' adapter reads it.

``Visit sensor 4 every third step`` becomes ``visit sensor K every Bth step``. The adapter answers in letters, so it
cannot invent a number; only code reads values and units.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from random import Random
from types import MappingProxyType

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
MOST_NUMBERS = 20

# fmt: off
CARDINALS = [
    "zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
    "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty",
]
ORDINALS = [
    "zeroth", "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth",
    "eleventh", "twelfth", "thirteenth", "fourteenth", "fifteenth", "sixteenth", "seventeenth", "eighteenth",
    "nineteenth", "twentieth",
]
_TENS = ["twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety"]
# fmt: on
# These words stay next to their letter: they carry more meaning than a number.
_FACTORS = {"twice": 2.0, "double": 2.0, "doubly": 2.0, "triple": 3.0, "tripple": 3.0, "thrice": 3.0, "half": 0.5}
_TELLING = {"zero": 0.0, "one": 1.0, "first": 1.0, "second": 2.0, "other": 2.0, "alternate": 2.0, **_FACTORS}


def _any(words: Iterable[str]) -> str:
    return "|".join(sorted(words, key=len, reverse=True))


_NUMBER = re.compile(
    r"(?P<clock>\d{1,2}:\d{2}(?::\d{2})?)"
    r"|(?P<digits>\d+(?:\.\d+)?)(?P<suffix>(?:st|nd|rd|th)\b)?"
    r"|(?<!per )(?<!\ba )(?P<second>\bsecond\b)"
    r"|(?<=every )(?P<alternate>other|alternate)\b"
    r"|(?<!quick )(?<!that )(?<!this )(?<!last )(?<!another )(?<!other )(?<!new )\bone\b(?! of )"
    r"|\b(?P<some>(?:a )?(?:couple(?: of)?|dozen))\b"
    rf"|\b(?P<tens>{_any(_TENS)})[- ](?P<ones>{_any(CARDINALS[1:10])})\b"
    rf"|\b(?P<word>{_any({*CARDINALS, *ORDINALS, *_TENS, *_FACTORS} - {'second', 'one'})})\b"
    r"|(?P<one>(?<!s )(?<!m )(?<!half )\ban?(?= (?:minute|hour)\b)|(?:(?<=every )|(?<=each ))(?=(?:minute|hour)\b))"
)
_UNITS = {
    "km/h": r"km/h|kmh|kph|kilomet(?:re|er)s? (?:per|an) hour",
    "mph": r"mph|miles (?:per|an) hour",
    "kn": r"kn|kts?|knots?",
    "m/s": r"m/s|mps|met(?:re|er)s? (?:per|a) second|met(?:re|er)s?/s(?:econd)?",
    "s": r"s|secs?|seconds?",
    "min": r"min|mins|minutes?",
    "h": r"h|hrs?|hours?",
    "m": r"m|met(?:re|er)s?",
    "km": r"km|kilomet(?:re|er)s?",
    "%": r"%|percent|per cent",
    "steps": r"(?:time )?steps?|rounds?|ticks?",
    "m²": r"m²",
}
_UNIT = re.compile(
    rf"(?:(?<=half) an?\b)?[ -]?(?:{'|'.join(f'(?P<u{i}>{unit})' for i, unit in enumerate(_UNITS.values()))})(?![\w/])"
)


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a note: its value, its unit if one follows, and where it stands in the lowered note."""

    value: float
    unit: str | None
    begin: int
    end: int


@dataclass(frozen=True, slots=True)
class LetteredNote:
    """A note whose numbers are letters.

    Attributes:
        text: what the adapter reads.
        numbers: each letter's number, in their order.
    """

    text: str
    numbers: Mapping[str, Number]

    @classmethod
    def of(cls, note: str, seed: int) -> LetteredNote:
        """The note with letters that the seed draws.

        Raises:
            ValueError: the note has more than 20 numbers.
        """
        lowered = note.lower()
        found = list(numbers_of(lowered))
        if len(found) > MOST_NUMBERS:
            raise ValueError(f"the note has more than {MOST_NUMBERS} numbers")
        letters = Random(seed).sample(LETTERS, len(found))
        parts, at = [], 0
        for letter, number in zip(letters, found, strict=True):
            parts += [lowered[at : number.begin], _shown(lowered, number, letter)]
            at = number.end
        text = " ".join("".join([*parts, lowered[at:]]).split())
        return cls(text, MappingProxyType(dict(zip(letters, found, strict=True))))


def numbers_of(lowered: str) -> list[Number]:
    """The numbers of a note in lower case; times of day are none."""
    found = []
    for match in _NUMBER.finditer(lowered):
        if (value := _value(match)) is not None:
            unit = _UNIT.match(lowered, match.end())
            named = None if unit is None else list(_UNITS)[int(str(unit.lastgroup)[1:])]
            found.append(Number(value, named, match.start(), match.end()))
    return found


def _value(match: re.Match[str]) -> float | None:
    if match["clock"]:
        return None
    if match["digits"]:
        return float(match["digits"][:9])
    if match["tens"]:
        return 10.0 * (_TENS.index(match["tens"]) + 2) + CARDINALS.index(match["ones"])
    some = "one" if match["some"] is None else "twelve" if "dozen" in match["some"] else "two"
    word = match["word"] or match["second"] or match["alternate"] or some
    if word in _TELLING:
        return _TELLING[word]
    for words in (CARDINALS, ORDINALS):
        if word in words:
            return float(words.index(word))
    return 10.0 * (_TENS.index(word) + 2)


def _shown(lowered: str, number: Number, letter: str) -> str:
    """The number's place in the adapter's text: its letter, with spaces around, ``th`` behind an ordinal's."""
    word = lowered[number.begin : number.end]
    before = " " if lowered[number.begin - 1 : number.begin].isalnum() else ""
    after = " " if lowered[number.end : number.end + 1].isalnum() else ""
    if word in _TELLING:
        return f"{before}{word} {letter}{after}"
    ordinal = word in ORDINALS or word.endswith(("st", "nd", "rd", "th"))
    return f"{before}{letter}{'th' if ordinal else ''}{after}"
