"""``python -m lab distill-orders``: made-up notes, training, evaluation, and the adapter's files."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import cycle, islice

from rich.console import Console

from lab.distilling.adapter_training import prepared, train_showing
from lab.distilling.note_examples import note_examples
from lab.distilling.note_student import NoteStudent, Understanding, understanding
from lab.distilling.options import DistillOrders
from lab.distilling.written_notes import WrittenNotes
from service.config.settings import Settings
from service.guidance.lettered_orders import STATIC
from service.llm.adapter_version import ORDERS
from service.llm.model_file import embedded_model, sha256

EVALUATED = 300
# The seed of the held-out notes; training has others.
_HELD_OUT_SEED = 1_000_000


def distill_orders(args: DistillOrders, console: Console) -> None:
    """Train an adapter and write its files.

    Raises:
        OSError, ValueError: the folder cannot be written, or is of another run.
        ModelMissing: the embedded model's file does not exist.
    """
    device = prepared(args)
    gguf = embedded_model(Settings())
    args.out.mkdir(parents=True, exist_ok=True)
    written = WrittenNotes(args.notes)
    if args.notes:
        console.print(
            f"{len(written)} written notes; {len(written.left_out)} are not of this language", highlight=False
        )
    kinds = cycle(
        (note_examples(args.seed), written.examples(args.seed)) if len(written) else (note_examples(args.seed),)
    )
    training = [next(next(kinds)) for _ in range(args.steps * args.batch)]
    student = NoteStudent(gguf, STATIC, args.rank, device, args.begin)
    train_showing(student, training, args, console)
    seen, unseen = (
        understanding(student, list(islice(note_examples(_HELD_OUT_SEED, held_out), EVALUATED)))
        for held_out in (False, True)
    )
    console.print(f"Right: {seen.right:.1%} of {seen.notes} new notes by known phrasings", highlight=False)
    console.print(f"Right: {unseen.right:.1%} of {unseen.notes} by held-out phrasings and operators", highlight=False)
    _write(student, seen, unseen, args)


def _write(student: NoteStudent, seen: Understanding, unseen: Understanding, args: DistillOrders) -> None:
    student.write_peft(args.out / "peft")
    target, gguf = args.out / "adapter.gguf", embedded_model(Settings())
    student.write_gguf(target, ORDERS)
    card = {
        "orders_version": ORDERS.number,
        "base": gguf.name,
        "base_sha256": sha256(gguf),
        "adapter_sha256": sha256(target),
        "steps": args.steps,
        "batch": args.batch,
        "rank": args.rank,
        "learning_rate": args.learning_rate,
        "seed": args.seed,
        "written_notes": [file.name for file in args.notes],
        "known_phrasings": asdict(seen),
        "held_out_phrasings": asdict(unseen),
    }
    (args.out / "card.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
