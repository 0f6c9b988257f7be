"""Written notes become examples: the letters of their orders mean what each note means."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from lab.distilling.written_notes import WrittenNotes, orders_of
from service.guidance.lettered_orders import meaning
from service.guidance.note_numbers import LetteredNote
from shared.planning.orders import NO_GUIDANCE, Guidance
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]
NOTES: list[tuple[str, dict[str, Any], str]] = [
    ("Sensor 4 every 3 steps.", {"sensors": [{"sensor_id": 4, "visit_every": 3}]}, "visit <4> every <3>"),
    ("See sensor 3 every third step.", {"sensors": [{"sensor_id": 3, "visit_every": 3}]}, "visit <3> every <third>"),
    (
        "Sensors 2 to 4 count double, and keep below 9 m/s or at it.",
        {"sensors": [{"sensor_id": i, "weight": 2} for i in (2, 3, 4)], "max_velocity": 9},
        "weigh <2>-<4> <double>; max <9>",
    ),
    ("Keep moving and ignore sensor 7.", {"sensors": [{"sensor_id": 7, "weight": 0}], "forbidden_velocities": [0]}, ""),
    ("All sensors at least once a minute.", {"sensors": [{"sensor_id": i, "visit_every": 6} for i in range(10)]}, ""),
]


@pytest.mark.parametrize(("note", "meant", "orders"), NOTES)
def test_the_letters_mean_the_note(note: str, meant: dict[str, Any], orders: str) -> None:
    guidance = Guidance.model_validate(meant)
    for seed in range(5):
        found = orders_of(note, guidance, seed)
        if found is None:
            # "Once a minute" is a period without a number of its own.
            assert "minute" in note
            continue
        lettered = LetteredNote.of(note, seed)
        assert found.text == lettered.text
        assert meaning(found.orders, lettered, PAPER).guidance == guidance
        if orders:
            named = orders
            for letter, number in lettered.numbers.items():
                named = named.replace(f"<{note.lower()[number.begin : number.end]}>", letter)
            assert found.orders == named


def test_what_no_letter_says_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / "notes.json"
    rows: list[dict[str, Any]] = [
        {"note": "Sensor 4 needs a look every 3 steps, somebody.", "guidance": NOTES[0][1]},
        {"note": "Sensor 4 is the one that I like.", "guidance": NOTES[0][1]},
        {"note": "The pump at sensor 8 was loud in the night of 12 May.", "guidance": None},
    ]
    file.write_text(json.dumps(rows))
    notes = WrittenNotes([file])
    assert notes.left_out == [rows[1]["note"]]
    drawn = list(islice(notes.examples(0), 20))
    assert {example.note for example in drawn} == {rows[0]["note"], rows[2]["note"]}
    assert len({example.text for example in drawn}) > 10
    assert {example.orders for example in drawn if example.note == rows[2]["note"]} == {"nothing"}
    assert orders_of(str(rows[1]["note"]), NO_GUIDANCE, 0) is not None
