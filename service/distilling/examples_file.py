"""The examples of a training run, kept in a file, so that an interrupted run need not make them again."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from service.distilling.examples import (
    EXPERIENCED,
    LEARNED,
    UNLEARNED,
    PromptExample,
    missions_of,
    prompt_examples,
    view_of,
)
from service.llm.adapter import PROMPT_VERSION
from service.llm.model_file import sha256
from shared.rollouts import read_rollouts

# Every so many missions of a file, one is held out, and seen in each of these views.
HELD_OUT = 11
_HELD_OUT_VIEWS = {"": LEARNED, " unlearned": UNLEARNED, " unlearned, experienced": EXPERIENCED}


@dataclass(frozen=True, slots=True)
class Examples:
    """A file's examples: those to train on, and those held out by the name of their scenario and view."""

    scenario: str
    training: list[PromptExample]
    held_out: dict[str, list[PromptExample]]


def examples_of(rollouts: Sequence[Path], folder: Path, workers: int) -> Iterator[Examples]:
    """The examples of each rollouts file.

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
    scenario = header.scenario.name
    training: list[Any] = []
    held_out: dict[str, list[Any]] = {scenario + suffix: [] for suffix in _HELD_OUT_VIEWS}
    for number, logged in enumerate(missions_of(steps)):
        if number % HELD_OUT:
            training += map(_plain, prompt_examples(header, logged, view_of(number)))
            continue
        for suffix, view in _HELD_OUT_VIEWS.items():
            held_out[scenario + suffix] += map(_plain, prompt_examples(header, logged, view))
    if not training:
        raise ValueError(f"{source} has no decision with a teacher in its second mission or later")
    half = kept.with_suffix(".part")
    with gzip.open(half, "wt", encoding="utf-8", compresslevel=3) as file:
        json.dump({"scenario": scenario, "training": training, "held_out": held_out}, file)
    half.replace(kept)
    return kept


def _read(kept: Path) -> Examples:
    with gzip.open(kept, "rt", encoding="utf-8") as file:
        found = json.load(file)
    held_out = {name: list(map(_example, some)) for name, some in found["held_out"].items()}
    return Examples(found["scenario"], list(map(_example, found["training"])), held_out)


def _example(fields: list[Any]) -> PromptExample:
    text, labels, target, sensors, reference = fields
    return PromptExample(text, labels, np.array(target), tuple(sensors), reference)


def _plain(example: PromptExample) -> list[Any]:
    fields = asdict(example)
    fields["target"] = [round(share, 4) for share in example.target.tolist()]
    return list(fields.values())
