"""An LLM's understanding of operators' notes: held-out notes, compiled as the edge compiles them.

    python -m lab.benchmarks.notes
    python -m lab.benchmarks.notes --notes lab/benchmarks/held_out_notes.json

It prints the guidance from each note, the number of right guidances and of wrong ones without a doubt, and by field the
orders found and the wrong orders; it writes the same as JSON. Two guidances are the same if they give the same orders.
A note whose `guidance` is null has no order that can be given, so the right answer is a refusal. The control uses no
LLM: it takes the orders of the most similar worked example, with the numbers of the note in place of the example's. An
LLM no better than the control understands nothing. The LLM is the edge's: set AICVDS_LLM_URL for another.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from service.config.settings import Settings
from service.guidance.note_compiler import compile_note
from service.guidance.note_orders import BadOrders, number_of, parse_orders, similar_examples
from service.guidance.note_phrases import PhrasedNote
from service.llm.answers import NoDecision
from service.llm.server_pool import ServerPool
from service.mission.prompt_fit import warm_up
from shared.planning.orders import Guidance, Impossible
from shared.world.scenario import SCENARIOS

NOTES = Path(__file__).with_name("notes.json")
FIELDS = ("visit_every", "weight", "min_velocity", "max_velocity", "forbidden_velocities")


@dataclass(frozen=True)
class Notes:
    """Compile the held-out notes and compare the results with their meaning."""

    notes: Path = NOTES
    """A JSON list of {"note": ..., "guidance": {...}}."""
    out: Path = Path("runs/notes.json")
    """Where to write the figures."""


@dataclass(frozen=True)
class CompiledNote:
    """One note: the guidance expected, the LLM's and the control's, and the LLM's error if it gives none."""

    note: str
    expected: Guidance | None
    llm: Guidance | None
    doubts: tuple[str, ...]
    error: str
    control: Guidance | None
    seconds: float


async def compiled(notes: list[dict[str, object]]) -> tuple[str | None, list[CompiledNote]]:
    """The LLM's name and the guidance compiled from each note."""
    upstream = ServerPool(settings := Settings(mode="llm"), warm_up(settings))
    upstream.start()
    while upstream.status == "loading":
        await asyncio.sleep(0.2)
    found = []
    try:
        for row in notes:
            note, begun, failure = str(row["note"]), time.monotonic(), ""
            llm: Guidance | None = None
            doubts: tuple[str, ...] = ()
            try:
                reading = await compile_note(PhrasedNote(note, SCENARIOS["paper"], ()), SCENARIOS["paper"], upstream)
                llm, doubts = reading.guidance, reading.doubts
            except (BadOrders, Impossible, NoDecision, TimeoutError) as error:
                failure = str(error) or "late"
            took = time.monotonic() - begun
            expected = None if row["guidance"] is None else Guidance.model_validate(row["guidance"])
            found.append(CompiledNote(note, expected, llm, doubts, failure, control(note), took))
    finally:
        await upstream.close()
    return upstream.notes_model, found


def control(note: str) -> Guidance | None:
    """The most similar example's orders with this note's numbers; None if the numbers do not fit."""
    example, orders = similar_examples(note, 1)[0]
    old, new = numbers(example), numbers(note)
    if len(old) != len(new):
        return None
    names = dict(zip(map(str, old), map(str, new), strict=True))
    try:
        return parse_orders(re.sub(r"[0-9]+", lambda match: names.get(match[0], match[0]), orders), note)
    except (BadOrders, Impossible):
        return None


def numbers(text: str) -> list[int]:
    """The numbers of a text, in order."""
    named = map(number_of, re.findall(r"[a-z]+|[0-9]+", text.lower()))
    return [number for number in named if number is not None]


def same(given: Guidance | None, expected: Guidance | None) -> bool:
    """Whether both give the same orders; for an ``expected`` of None, whether none are given."""
    if given is None or expected is None:
        return expected is None and not given
    levels, most = (
        SCENARIOS["paper"].max_velocity + 1,
        1 + max((w.sensor_id for w in given.sensors + expected.sensors), default=0),
    )
    return (
        np.array_equal(given.allowed(levels), expected.allowed(levels))
        and np.array_equal(given.weights(most), expected.weights(most))
        and np.array_equal(given.visit_intervals(most), expected.visit_intervals(most))
    )


def facts(guidance: Guidance | None) -> set[tuple[str, int, float]]:
    """The orders of a guidance: field, sensor (-1: none), value."""
    if guidance is None:
        return set()
    orders = {("visit_every", w.sensor_id, float(w.visit_every)) for w in guidance.sensors if w.visit_every is not None}
    orders |= {("weight", w.sensor_id, w.weight) for w in guidance.sensors if w.weight != 1.0}
    orders |= {("forbidden_velocities", -1, float(level)) for level in guidance.forbidden_velocities}
    limits = {"min_velocity": guidance.min_velocity, "max_velocity": guidance.max_velocity}
    return orders | {(name, -1, float(level)) for name, level in limits.items() if level is not None}


def main(options: Notes) -> None:
    """Run, print, write."""
    console = Console()
    model, rows = asyncio.run(compiled(json.loads(options.notes.read_text())))
    table = Table("", "note", "understood", title=str(model))
    for row in rows:
        text = f"({row.error})" if row.llm is None else " ".join((row.llm.in_words(), *row.doubts))
        table.add_row("right" if same(row.llm, row.expected) else "", row.note, text)
    console.print(table)
    result: dict[str, object] = {"model": model, "notes": len(rows)}
    for reader in ("llm", "control"):
        given = [getattr(row, reader) for row in rows]
        exact = sum(same(one, row.expected) for one, row in zip(given, rows, strict=True))
        silent = sum(one is None and row.expected is not None for one, row in zip(given, rows, strict=True))
        result[reader] = {"exact": exact, "nothing": silent, "wrong": len(rows) - exact - silent}
        console.print(f"{reader}: {exact} of {len(rows)} right, {silent} refused, {len(rows) - exact - silent} wrong")
        answers = [(facts(row.expected), one) for one, row in zip(given, rows, strict=True)]
        for name in FIELDS:
            pairs = [({f for f in m if f[0] == name}, {f for f in facts(g) if f[0] == name}) for m, g in answers]
            expected, answered = (sum(len(pair[i]) for pair in pairs) for i in (0, 1))
            both = sum(len(own & other) for own, other in pairs)
            result[f"{reader}_{name}"] = {"asked": expected, "found": both, "said": answered}
            console.print(f"  {name}: {both} of {expected} found, {answered - both} of {answered} wrong")
    certain = [row for row in rows if row.llm and not row.doubts]
    wrong = sum(not same(row.llm, row.expected) for row in certain)
    result |= {"certain": len(certain), "wrong_and_certain": wrong}
    console.print(f"{len(certain)} with orders and without a doubt, of which {wrong} wrong")
    result["seconds_mean"] = round(sum(row.seconds for row in rows) / len(rows), 2)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    console.print(f"{result['seconds_mean']} s a note; wrote {options.out}", highlight=False)


if __name__ == "__main__":
    main(tyro.cli(Notes, description=__doc__))
