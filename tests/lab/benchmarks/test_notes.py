"""The held-out notes: the rules misread none of them without a doubt."""

from __future__ import annotations

import json

import pytest

from lab.benchmarks.notes import NOTES, same
from service.guidance.note_orders import BadOrders
from service.guidance.note_phrases import PhrasedNote
from service.guidance.plain_reading import plain_reading
from shared.planning.orders import Guidance, Impossible
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]


@pytest.mark.parametrize(
    "name", ["notes.json", "held_out_notes.json", "notes_of_others.json", "notes_that_mislead.json", "fresh_notes.json"]
)
def test_the_rules_misread_no_note_and_read_most_but_those_that_mislead(name: str) -> None:
    read, rows = 0, json.loads(NOTES.with_name(name).read_text(encoding="utf-8"))
    for row in rows:
        note = PhrasedNote(row["note"], PAPER, ())
        values = {} if note.is_read else plain_reading(note.text, PAPER)
        if values is None or note.unsaid:
            continue
        read += 1
        try:
            guidance, doubts = note.completed(Guidance.of(values, {}), values.values())
        except (BadOrders, Impossible):
            # Code refuses what the rules have read.
            continue
        meant = None if row["guidance"] is None else Guidance.model_validate(row["guidance"])
        # Code may leave out a doubtful order and say so. The note must mean the rest.
        left_out = any(doubt.startswith("In no order") for doubt in doubts)
        assert same(guidance, meant) or (left_out and meant and guidance.values.items() <= meant.values.items()), row
    assert read > (0.6 * len(rows) if name in ("notes.json", "held_out_notes.json", "notes_of_others.json") else 0)
