"""The examples of a training run, kept in a file, so that an interrupted run need not make them again."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from service.distilling.examples import PromptExample, prompt_examples
from service.llm.adapter import PROMPT_VERSION
from service.llm.model_file import sha256
from shared.rollouts import read_rollouts

# Every so many missions of a file, one is held out.
HELD_OUT = 11


def examples_of(
    rollouts: Sequence[Path], folder: Path, workers: int
) -> Iterator[tuple[str, list[PromptExample], list[PromptExample]]]:
    """For each rollouts file: its scenario, its training examples and its held-out ones.

    Raises:
        OSError, ValueError: a file cannot be read, or has no teacher.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(source, folder / f"examples-{PROMPT_VERSION}-{sha256(source)[:16]}.json.gz") for source in rollouts]
    if workers == 1:
        for kept in map(_kept, jobs):
            yield _read(kept)
        return
    with get_context("spawn").Pool(workers) as pool:
        for kept in pool.imap(_kept, jobs):
            yield _read(kept)


def _kept(job: tuple[Path, Path]) -> Path:
    """Make a file's examples, unless they are there; raises ``ValueError`` where there is nothing to train on."""
    source, kept = job
    if kept.is_file():
        return kept
    header, steps = read_rollouts(source)
    missions = [[_plain(example) for example in mission] for mission in prompt_examples(header, steps)]
    if not any(mission for number, mission in enumerate(missions) if number % HELD_OUT):
        raise ValueError(f"{source} has no decision with a teacher in its second mission or later")
    half = kept.with_suffix(".part")
    with gzip.open(half, "wt", encoding="utf-8", compresslevel=3) as file:
        json.dump({"scenario": header.scenario.name, "missions": missions}, file)
    half.replace(kept)
    return kept


def _read(kept: Path) -> tuple[str, list[PromptExample], list[PromptExample]]:
    with gzip.open(kept, "rt", encoding="utf-8") as file:
        found = json.load(file)
    train: list[PromptExample] = []
    held: list[PromptExample] = []
    for number, mission in enumerate(found["missions"]):
        part = train if number % HELD_OUT else held
        part += [
            PromptExample(t, labels, np.array(target), tuple(sensors), r) for t, labels, target, sensors, r in mission
        ]
    return found["scenario"], train, held


def _plain(example: PromptExample) -> list[Any]:
    fields = asdict(example)
    fields["target"] = [round(share, 4) for share in example.target.tolist()]
    return list(fields.values())
