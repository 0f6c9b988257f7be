"""Operators' notes that are made up, with the orders that each means: the orders' adapter is trained on them.

A note is one to four clauses of one operator. A clause is a phrasing of ``phrasings.toml`` whose alternatives and
fields are drawn; ``operators.toml`` says how the operators name sensors and join clauses. Every seventh phrasing, and
the operators that are held out, are of no training note.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from lab.distilling.note_fields import Fields, Piece, Pieces
from service.guidance.note_numbers import LetteredNote, numbers_of

_HERE = Path(__file__).parent
_HELD_OUT_EVERY = 7
_INNERMOST = re.compile(r"\[([^\[\]]*)\]")
_FIELD = re.compile(r"\{([A-Za-z]+2?)\}|<([^<>/]*)/([^<>/]*)>")
_TYPO_SHARE = 0.08


@dataclass(frozen=True, slots=True)
class NoteExample:
    """A note, its text for the adapter with letters for numbers, and its orders in the adapter's language."""

    note: str
    text: str
    orders: str


@dataclass(frozen=True, slots=True)
class Clause:
    """A part of a note: its pieces, and its orders with a number's key in braces."""

    pieces: Pieces
    orders: str


@cache
def _tables(name: str) -> dict[str, Any]:
    return tomllib.loads((_HERE / name).read_text(encoding="utf-8"))


def phrasings(kind: str, held_out: bool) -> Sequence[str]:
    """The phrasings of a kind: the held-out ones, every seventh, or the others."""
    return [
        text
        for number, text in enumerate(_tables("phrasings.toml")[kind]["phrasings"])
        if (number % _HELD_OUT_EVERY == 3) == held_out
    ]


def operators(held_out: bool) -> Sequence[Mapping[str, Any]]:
    """The operators that are held out, or the others."""
    return [operator for operator in _tables("operators.toml").values() if operator.get("held_out", False) == held_out]


def note_examples(seed: int, held_out: bool = False) -> Iterator[NoteExample]:
    """An endless sequence of notes.

    Args:
        held_out: whether the notes have the phrasings and operators that training never uses.
    """
    random = Random(f"{seed} {held_out}")
    while True:
        yield _Note(random, held_out).example()


class _Note:
    """The writer of one note."""

    def __init__(self, random: Random, held_out: bool) -> None:
        self._random = random
        self._held_out = held_out
        self._operator = random.choice(operators(held_out))
        self._fields = Fields(random, self._operator)

    def example(self) -> NoteExample:
        """The note, its text with letters for numbers, and its orders."""
        clauses = self._clauses()
        pieces = self._joined(clauses)
        if self._random.random() < _TYPO_SHARE:
            pieces = self._with_typo(pieces)
        note = "".join(piece.text for piece in pieces)
        lettered = LetteredNote.of(note, self._random.randrange(1 << 30))
        at = {number.begin: letter for letter, number in lettered.numbers.items()}
        place, letters = 0, {}
        for piece in pieces:
            if piece.key is not None:
                letters[piece.key] = at[place]
            place += len(piece.text)
        orders = [clause.orders for clause in clauses if clause.orders != "nothing"]
        kept = [order for order in orders if order != "unclear"]
        # The order `unclear` comes once, at the end.
        answer = "; ".join(kept + ["unclear"] * (len(kept) < len(orders))) or "nothing"
        return NoteExample(note, lettered.text, answer.format_map(letters))

    def _clauses(self) -> list[Clause]:
        draw = self._random.random()
        if draw < 0.09:
            return [self._clause("nothing") for _ in range(self._random.choice((1, 1, 2)))]
        if draw < 0.22:
            clauses = [self._clause("unclear")]
            if self._random.random() < 0.4:
                clauses.insert(self._random.randrange(2), self._order())
        elif draw < 0.36:
            clauses = self._about_pronoun()
        else:
            clauses = [self._order() for _ in range(self._random.choice((1, 1, 1, 1, 2, 2, 2, 3)))]
            if len(clauses) == 1 and self._random.random() < 0.1 and not clauses[0].orders.startswith(("m", "a")):
                clauses.append(self._clause("others"))
        if self._random.random() < 0.12:
            clauses.insert(self._random.randrange(len(clauses) + 1), self._clause("nothing"))
        if self._random.random() < 0.08 and all(clause.orders != "unclear" for clause in clauses):
            clauses.append(self._clause(self._random.choice(("until", "until", "for"))))
        return clauses

    def _order(self) -> Clause:
        shares = {kind: own["share"] for kind, own in _tables("phrasings.toml").items() if "share" in own}
        kind = self._random.choices(list(shares), list(shares.values()))[0]
        clause = self._clause(kind)
        reason = self._random.choice(self._operator["reasons"])
        return Clause((*clause.pieces, Piece(self._chosen(reason))), clause.orders)

    def _about_pronoun(self) -> list[Clause]:
        """An opening that names a sensor, and one or two orders about it."""
        lead = self._filled(self._chosen(self._random.choice(self._operator["leads"])))
        key = self._fields.last_sensors
        self._fields.pronoun = key
        kinds = self._random.choice(
            (["visit_of_it"], ["visit_of_it"], ["weight_of_it"], ["visit_of_it", "weight_of_it"])
        )
        clauses = [self._clause(kind, it=key) for kind in kinds]
        colon = self._random.choice((": ", ": ", ". ", ", ", " - ", "; "))
        first = Clause((*lead, Piece(colon), *clauses[0].pieces), clauses[0].orders)
        more = [self._order()] if self._random.random() < 0.35 else []
        return [first, *clauses[1:], *more]

    def _clause(self, kind: str, it: str = "") -> Clause:
        template = self._chosen(self._random.choice(phrasings(kind, self._held_out)))
        means: str = _tables("phrasings.toml")[kind]["means"]
        pieces = self._filled(template)
        orders = _FIELD.sub(lambda found: it if found[1] == "S" and it else self._fields.keys[found[1]], means)
        return Clause(pieces, orders)

    def _chosen(self, template: str) -> str:
        """The template with one alternative of each group."""
        while found := _INNERMOST.search(template):
            template = template[: found.start()] + self._random.choice(found[1].split("|")) + template[found.end() :]
        return " ".join(template.split(" "))

    def _filled(self, template: str) -> Pieces:
        pieces: list[Piece] = []
        at = 0
        for found in _FIELD.finditer(template):
            pieces.append(Piece(template[at : found.start()]))
            at = found.end()
            if found[1]:
                before = "".join(piece.text for piece in pieces)
                pieces += self._fields.write(found[1], before)
            else:
                pieces.append(Piece(found[3] if self._fields.plural else found[2]))
        pieces.append(Piece(template[at:]))
        return tuple(pieces)

    def _joined(self, clauses: Sequence[Clause]) -> Pieces:
        pieces = [Piece(self._chosen(self._random.choice(self._operator["openers"])))]
        for number, clause in enumerate(clauses):
            if number:
                pieces.append(Piece(self._random.choice(self._operator["joiners"])))
            pieces += clause.pieces
        closer = self._chosen(self._random.choice(self._operator["closers"]))
        pieces.append(Piece(f". {closer}" if closer else self._random.choice((".", ".", ".", "", "!"))))
        return tuple(Piece(piece.text.lower(), piece.key) for piece in pieces)

    def _with_typo(self, pieces: Pieces) -> Pieces:
        """Swap two neighbouring letters of one word outside numbers."""
        long = [
            (number, found.start())
            for number, piece in enumerate(pieces)
            if piece.key is None
            for found in re.finditer(r"[a-z]{5,}", piece.text)
            # "Other" is a number behind "every".
            if not numbers_of(found[0]) and found[0] != "every"
        ]
        if not long:
            return pieces
        number, start = self._random.choice(long)
        text, at = pieces[number].text, start + self._random.randrange(1, 3)
        swapped = text[:at] + text[at + 1] + text[at] + text[at + 2 :]
        return (*pieces[:number], Piece(swapped), *pieces[number + 1 :])
