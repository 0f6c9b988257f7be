"""An LLM's understanding of operators' notes: 30 held-out notes, compiled as the edge compiles them.

    python benchmarks/notes.py

It prints the guidance from each note, the number of exactly right structures, and by field the orders that were found
and the orders that are wrong; it writes the same as JSON. A control works without any LLM: the most similar worked
example's orders, with this note's numbers in place of the example's, in their order. An LLM no better than the control
has understood nothing. The LLM is the edge's: set AICVDS_LLM_URL for another.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from service.config.settings import Settings
from service.guidance.note_compiler import compile_note
from service.guidance.note_orders import BadOrders, number_of, parse_orders, similar_examples
from service.llm.answers import NoDecision
from service.llm.server_pool import ServerPool
from service.prompting.warm_up import warm_up
from shared.guidance import Guidance, Impossible
from shared.scenario import SCENARIOS

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
class Understood:
    """One note: its meaning, the guidance compiled from it, and the failure if there is none."""

    note: str
    meant: Guidance
    llm: Guidance | None
    why: str
    control: Guidance | None
    seconds: float


async def understood(notes: list[dict[str, object]]) -> tuple[str | None, list[Understood]]:
    """The LLM's name and the guidance compiled from each note."""
    upstream = ServerPool(settings := Settings(mode="llm"), warm_up(settings))
    upstream.start()
    while upstream.status == "loading":
        await asyncio.sleep(0.2)
    found = []
    try:
        for row in notes:
            note, begun, why = str(row["note"]), time.monotonic(), ""
            llm: Guidance | None = None
            try:
                llm = await compile_note(note, SCENARIOS["paper"], upstream)
            except (BadOrders, Impossible, NoDecision, TimeoutError) as error:
                why = str(error) or "late"
            took = time.monotonic() - begun
            found.append(Understood(note, Guidance.model_validate(row["guidance"]), llm, why, control(note), took))
    finally:
        await upstream.close()
    return upstream.active.model, found


def control(note: str) -> Guidance | None:
    """The most similar example's orders with this note's numbers; None if the numbers do not fit."""
    example, orders = similar_examples(note, 1)[0]
    theirs, ours = numbers(example), numbers(note)
    if len(theirs) != len(ours):
        return None
    names = dict(zip(map(str, theirs), map(str, ours), strict=True))
    try:
        return parse_orders(re.sub(r"[0-9]+", lambda found: names.get(found[0], found[0]), orders), note)
    except BadOrders:
        return None


def numbers(text: str) -> list[int]:
    """The numbers of a text, in order."""
    named = map(number_of, re.findall(r"[a-z]+|[0-9]+", text.lower()))
    return [number for number in named if number is not None]


def facts(guidance: Guidance | None) -> set[tuple[str, int, float]]:
    """A structure's orders: field, sensor (-1: none), value."""
    if guidance is None:
        return set()
    asked = {("visit_every", w.sensor_id, float(w.visit_every)) for w in guidance.sensors if w.visit_every is not None}
    asked |= {("weight", w.sensor_id, w.weight) for w in guidance.sensors if w.weight != 1.0}
    asked |= {("forbidden_velocities", -1, float(level)) for level in guidance.forbidden_velocities}
    limits = {"min_velocity": guidance.min_velocity, "max_velocity": guidance.max_velocity}
    return asked | {(name, -1, float(level)) for name, level in limits.items() if level is not None}


def main(asked: Notes) -> None:
    """Run, print, write."""
    console = Console()
    model, rows = asyncio.run(understood(json.loads(asked.notes.read_text())))
    told = Table("", "note", "understood", title=str(model))
    for row in rows:
        right = facts(row.llm) == facts(row.meant) and row.llm is not None
        told.add_row("right" if right else "", row.note, row.llm.in_words() if row.llm is not None else f"({row.why})")
    console.print(told)
    result: dict[str, object] = {"model": model, "notes": len(rows)}
    for who in ("llm", "control"):
        answers = [(facts(row.meant), getattr(row, who)) for row in rows]
        exact = sum(given is not None and facts(given) == meant for meant, given in answers)
        silent = sum(given is None for _, given in answers)
        result[who] = {"exact": exact, "nothing": silent, "wrong": len(rows) - exact - silent}
        console.print(f"{who}: {exact} of {len(rows)} right, {silent} refused, {len(rows) - exact - silent} wrong")
        for name in FIELDS:
            pairs = [({f for f in m if f[0] == name}, {f for f in facts(g) if f[0] == name}) for m, g in answers]
            wanted, given = (sum(len(pair[i]) for pair in pairs) for i in (0, 1))
            both = sum(len(meant & said) for meant, said in pairs)
            result[f"{who}_{name}"] = {"asked": wanted, "found": both, "said": given}
            console.print(f"  {name}: {both} of {wanted} found, {given - both} of {given} wrong")
    result["seconds_mean"] = round(sum(row.seconds for row in rows) / len(rows), 2)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    asked.out.write_text(json.dumps(result, indent=1) + "\n")
    console.print(f"{result['seconds_mean']} s a note; wrote {asked.out}", highlight=False)


if __name__ == "__main__":
    main(tyro.cli(Notes, description=__doc__))
