"""``python -m lab distill``: examples, training, evaluation, and the adapter's files."""

from __future__ import annotations

import json
import random
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from lab.distilling.adapter_training import prepared, train_showing
from lab.distilling.decision_student import Agreement, DecisionStudent, agreement
from lab.distilling.examples import PromptExample
from lab.distilling.examples_file import examples_of
from lab.distilling.options import Distill
from lab.executors import ordered_map
from service.config.settings import Settings
from service.llm.adapter_version import DECISIONS, PROMPT_VERSION
from service.llm.model_file import embedded_model, sha256
from service.prompting.compact_prompt import STATIC

# Held-out decisions of each scenario that are evaluated.
EVALUATED = 300


def distill(args: Distill, console: Console) -> None:
    """Train an adapter and write its files; without rollouts, write the earlier adapter's.

    Raises:
        OSError, ValueError: a file cannot be read, or has nothing to train on.
        RayUnusable: there is no such Ray.
        ModelMissing: the embedded model's file does not exist.
    """
    device = prepared(args)
    gguf = embedded_model(Settings())
    if not args.rollouts:
        _write_adapter(DecisionStudent(gguf, STATIC, args.rank, device, args.begin), args.out)
        return
    training: list[PromptExample] = []
    held_out: dict[str, list[PromptExample]] = {}
    with ordered_map(args.workers, args.ray) as each:
        for found in examples_of(args.rollouts, args.out, each):
            held = sum(map(len, found.held_out.values()))
            console.print(f"{found.scenario}: {len(found.training)} decisions, {held} held out", highlight=False)
            training += found.training
            for name, examples in found.held_out.items():
                held_out.setdefault(name, []).extend(examples)
    student = DecisionStudent(gguf, STATIC, args.rank, device, args.begin)
    train_showing(student, training, args, console)
    agreed = {name: agreement(student, _sample(examples)) for name, examples in held_out.items() if examples}
    _report(agreed, console)
    _write(student, agreed, gguf, len(training), args)


def _sample(examples: list[PromptExample]) -> list[PromptExample]:
    return random.Random(0).sample(examples, min(EVALUATED, len(examples)))


def _report(agreements: dict[str, Agreement], console: Console) -> None:
    for name, one in agreements.items():
        console.print(
            f"{name}: the teacher's sensor in {one.sensor:.0%} of {one.decisions} held-out decisions, "
            f"loss {one.loss:.3f}",
            highlight=False,
        )


def _write(student: DecisionStudent, found: dict[str, Agreement], gguf: Path, examples: int, args: Distill) -> None:
    target = _write_adapter(student, args.out)
    card = {
        "prompt_version": PROMPT_VERSION,
        "base": gguf.name,
        "base_sha256": sha256(gguf),
        "adapter_sha256": sha256(target),
        "rollouts": sorted(source.name for source in args.rollouts),
        "examples": examples,
        "steps": args.steps,
        "batch": args.batch,
        "rank": args.rank,
        "learning_rate": args.learning_rate,
        "seed": args.seed,
        "held_out": {name: asdict(one) for name, one in sorted(found.items())},
    }
    (args.out / "card.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def _write_adapter(student: DecisionStudent, folder: Path) -> Path:
    """Write the adapter in both formats; returns llama.cpp's file."""
    folder.mkdir(parents=True, exist_ok=True)
    student.write_peft(folder / "peft")
    target = folder / "adapter.gguf"
    student.write_gguf(target, DECISIONS)
    return target
