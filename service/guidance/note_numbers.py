"""The numbers of an operator's note, each replaced by a letter: the note as the orders' adapter reads it.

``Visit sensor 4 every third step`` becomes ``visit sensor K every Bth step``. The adapter answers in letters, so it
cannot invent a number; only code reads values and units. ``note_numbers.toml`` has their words.
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from random import Random
from types import MappingProxyType

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
MOST_NUMBERS = 20

_TABLE = tomllib.loads(files("service.guidance").joinpath("note_numbers.toml").read_text(encoding="utf-8"))
CARDINALS, ORDINALS, _TENS = (str(_TABLE["words"][kind]).split() for kind in ("cardinals", "ordinals", "tens"))
_FACTORS, _UNITS = _TABLE["factors"], _TABLE["units"]
_TELLING: dict[str, float] = {**_TABLE["telling"], **_FACTORS}
_KINDS = {"tens": {*_TENS}, "ones": {*CARDINALS[1:10]}}
_KINDS["word"] = {*CARDINALS, *ORDINALS, *_TENS, *_FACTORS} - {"second", "one"}
_WORDS = {kind: "|".join(sorted(words, key=lambda word: (-len(word), word))) for kind, words in _KINDS.items()}
_NUMBER = re.compile(
    "|".join(re.sub(r"\[(\w+)\]", lambda kind: _WORDS[kind[1]], row) for row in _TABLE["number"]["any"])
)
_UNIT = re.compile(
    rf"(?:(?<=half) an?\b)?[ -]?(?:{'|'.join(f'(?P<u{i}>{unit})' for i, unit in enumerate(_UNITS.values()))})(?![\w/])"
)


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a note: its value, its unit if one follows, where it stands in the lowered note, and its form."""

    value: float
    unit: str | None
    begin: int
    end: int
    is_ordinal: bool = False


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
    def of(cls, note: str, seed: int) -> "LetteredNote":
        """The note with letters that the seed draws; raises ``ValueError`` if it has more than 20 numbers."""
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
            found.append(Number(value, named, *match.span(), bool(match["suffix"]) or match["word"] in ORDINALS))
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
