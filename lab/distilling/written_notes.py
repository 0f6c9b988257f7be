"""Operators' notes that were written one by one, with their orders in the adapter's language.

A file has notes with the guidance that each means; language models wrote ours, in the roles of operators. The letters
of a note's orders are found by search: those that mean the guidance, and whose numbers stand nearest to each other.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from random import Random
from typing import Any

from lab.distilling.note_examples import NoteExample
from service.guidance.lettered_orders import ALL, MOVE, NOTHING, SEPARATOR, meaning
from service.guidance.note_numbers import LetteredNote, Number
from service.guidance.note_orders import BadOrders
from service.guidance.note_phrases import PhrasedNote
from shared.planning.orders import NO_GUIDANCE, Guidance
from shared.world.scenario import SCENARIOS

_PAPER = SCENARIOS["paper"]
# A note with more combinations of letters is left out.
_MOST_CHOICES = 20_000
_ALL = re.compile(r"\b(?:all|every(?!one|body)|each|whole|any)\b")


class WrittenNotes:
    """The notes of some files, as far as the adapter's language can express their orders.

    Attributes:
        left_out: the notes whose orders it cannot express.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._notes: list[tuple[str, Guidance]] = []
        self.left_out: list[str] = []
        for file in files:
            for row in json.loads(file.read_text(encoding="utf-8")):
                try:
                    guidance = NO_GUIDANCE if row["guidance"] is None else Guidance.model_validate(row["guidance"])
                except ValueError:
                    self.left_out.append(row["note"])
                    continue
                # The adapter gets the rest of a note, without the phrases that the edge reads.
                phrased = PhrasedNote(row["note"], _PAPER, {})
                if phrased.orders or phrased.is_read or orders_of(phrased.text, guidance, 0) is None:
                    self.left_out.append(row["note"])
                else:
                    self._notes.append((phrased.text, guidance))

    def __len__(self) -> int:
        return len(self._notes)

    def examples(self, seed: int) -> Iterator[NoteExample]:
        """An endless sequence of passes over all notes in random order, each note with other letters each time."""
        random = Random(f"written {seed}")
        while self._notes:
            for note, guidance in random.sample(self._notes, len(self._notes)):
                found = orders_of(note, guidance, random.randrange(1 << 30))
                assert found is not None
                yield found


def orders_of(note: str, guidance: Guidance, seed: int) -> NoteExample | None:
    """A note and the letters of its orders; None if no letters mean the guidance."""
    try:
        lettered = LetteredNote.of(note, seed)
    except ValueError:
        return None
    choices = list(_choices(lettered, guidance, note.lower()))
    count = 1
    for each in choices:
        count *= len(each)
    if not 0 < count <= _MOST_CHOICES:
        return None
    at = {letter: number.begin for letter, number in lettered.numbers.items()}
    best: tuple[float, list[str]] | None = None
    for chosen in product(*choices):
        # A number is in one order, except for sensors in two orders and for a velocity that is both min and max.
        kinds = [(letter, kind) for order in chosen for letter, kind in _used(order)]
        letters = [letter for letter, kind in kinds if kind not in ("sensor", "max")]
        letters += {letter for letter, kind in kinds if kind == "max"} - {one for one, kind in kinds if kind == "min"}
        others = {letter for letter, kind in kinds if kind == "sensor"}
        if len(set(letters)) < len(letters) or others & set(letters):
            continue
        span = float(sum(_span([at[letter] for letter, _ in _used(order)]) for order in chosen))
        if best is None or span < best[0]:
            best = span, sorted(chosen, key=lambda order: min((at[one] for one, _ in _used(order)), default=0))
    if best is None:
        return None
    answer = SEPARATOR.join(best[1]) or NOTHING
    try:
        read = meaning(answer, lettered, _PAPER)
    except BadOrders:
        return None
    return (
        NoteExample(note, lettered.text, answer)
        if (read.guidance.values, read.guidance.ends) == (guidance.values, {})
        else None
    )


def _span(places: Sequence[int]) -> int:
    return max(places, default=0) - min(places, default=0)


def _used(order: str) -> list[tuple[str, str]]:
    """The letters of an order, and whether each is a sensor's."""
    kind, *terms = order.replace("-", " ").split()
    sensors = {"visit": len(terms) if terms[-1:] == ["always"] else len(terms) - 2, "weigh": len(terms) - 1}
    count = sensors.get(kind, len(terms) if kind == "ignore" else 0)
    return [(term, "sensor" if place < count else kind) for place, term in enumerate(terms) if len(term) == 1]


def _choices(lettered: LetteredNote, guidance: Guidance, lowered: str) -> Iterator[list[str]]:
    """For each order of the guidance, its forms in letters."""
    values: dict[str, dict[float, list[int]]] = {"visit_every": {}, "weight": {}}
    for wish in guidance.sensors:
        for field, groups in values.items():
            value = getattr(wish, field)
            # Lost packets count once by default.
            if value is not None and (field, value) != ("weight", 1.0):
                groups.setdefault(float(value), []).append(wish.sensor_id)
    for every, sensors in values["visit_every"].items():
        periods = [letter for letter in lettered.numbers if _means(lettered, f"visit {ALL} every {letter}", every)]
        ends = [f" every {letter}" for letter in periods] + [" always"] * (every == 1)
        yield [f"visit {form}{end}" for form in _sensor_forms(lettered, sensors, lowered) for end in ends]
    for weight, sensors in values["weight"].items():
        forms = _sensor_forms(lettered, sensors, lowered)
        factors = [one for one, number in lettered.numbers.items() if _factor(number) == weight]
        yield (
            [f"ignore {form}" for form in forms]
            if weight == 0
            else [f"weigh {form} {one}" for form in forms for one in factors]
        )
    for kind, level in (("max", guidance.max_velocity), ("min", guidance.min_velocity)):
        if level is not None:
            yield [f"{kind} {one}" for one in lettered.numbers if _level(lettered, f"{kind} {one}", kind) == level]
    if forbidden := list(guidance.forbidden_velocities):
        letters_of = [[one for one in lettered.numbers if _avoids(lettered, one) == level] for level in forbidden]
        if forbidden[0] == 0 and not letters_of[0]:
            yield [MOVE]
            letters_of = letters_of[1:]
        if letters_of:
            yield [f"avoid {' '.join(letters)}" for letters in product(*letters_of)]


def _sensor_forms(lettered: LetteredNote, sensors: list[int], lowered: str) -> list[str]:
    """The forms of an order's sensors: their letters, a range, or all."""
    own = [
        [one for one, number in lettered.numbers.items() if number.unit is None and number.value == sensor]
        for sensor in sensors
    ]
    at = {letter: number.begin for letter, number in lettered.numbers.items()}
    found = [" ".join(sorted(letters, key=at.__getitem__)) for letters in product(*own)]
    if not found and len(sensors) > 2 and sensors == list(range(sensors[0], sensors[-1] + 1)):
        found = [f"{first}-{last}" for first in own[0] for last in own[-1] if at[first] < at[last]]
    if not found and sensors == list(range(_PAPER.sensors)) and _ALL.search(lowered):
        found = [ALL]
    return found


def _factor(number: Number) -> float | None:
    return number.value / 100 if number.unit == "%" else None if number.unit else number.value


def _read(lettered: LetteredNote, order: str) -> Guidance | None:
    try:
        return meaning(order, lettered, _PAPER).guidance
    except BadOrders:
        return None


def _means(lettered: LetteredNote, order: str, every: float) -> bool:
    read = _read(lettered, order)
    return read is not None and read.sensors[0].visit_every == every


def _level(lettered: LetteredNote, order: str, kind: str) -> Any:
    read = _read(lettered, order)
    return None if read is None else read.max_velocity if kind == "max" else read.min_velocity


def _avoids(lettered: LetteredNote, letter: str) -> int | None:
    read = _read(lettered, f"avoid {letter}")
    return None if read is None else read.forbidden_velocities[0]
