"""The examples of a training run, kept in a file, so that an interrupted run need not make them again."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lab.distilling.examples import (
    EXPERIENCED,
    LEARNED,
    UNLEARNED,
    PromptExample,
    missions_of,
    prompt_examples,
    view_of,
)
from lab.executors import OrderedMap
from lab.exploration.rollouts import Header, RolloutStep, read_rollouts
from service.llm.adapter_version import PROMPT_VERSION
from service.llm.model_file import sha256

# One in this many missions of a file is held out, and shown in each of these views.
HELD_OUT = 11
_HELD_OUT_VIEWS = {"": LEARNED, " unlearned": UNLEARNED, " unlearned, experienced": EXPERIENCED}


@dataclass(frozen=True, slots=True)
class Examples:
    """A file's examples: those to train on, and those held out by the name of their scenario and view."""

    scenario: str
    training: list[PromptExample]
    held_out: dict[str, list[PromptExample]]


def examples_of(rollouts: Sequence[Path], folder: Path, each: OrderedMap = map) -> Iterator[Examples]:
    """The examples of each rollouts file.

    Args:
        folder: of the files in which the examples are stored.
        each: makes the examples of the missions.

    Raises:
        OSError, ValueError: a file cannot be read, or has no teacher.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for source in rollouts:
        kept = folder / f"examples-{PROMPT_VERSION}-{sha256(source)[:16]}.json.gz"
        if not kept.is_file():
            _make(source, kept, each)
        yield _read(kept)


def _make(source: Path, kept: Path, each: OrderedMap) -> None:
    """Make a file's examples; raises ``ValueError`` where there is nothing to train on."""
    header, steps = read_rollouts(source)
    scenario = header.scenario.name
    training: list[Any] = []
    held_out: dict[str, list[Any]] = {scenario + suffix: [] for suffix in _HELD_OUT_VIEWS}
    missions = ((header, number, logged) for number, logged in enumerate(missions_of(steps)))
    for suffix, examples in chain.from_iterable(each(_of_mission, missions)):
        target = training if suffix is None else held_out[scenario + suffix]
        target += examples
    if not training:
        raise ValueError(f"{source} has no decision with a teacher in its second mission or later")
    half = kept.with_suffix(".part")
    with gzip.open(half, "wt", encoding="utf-8", compresslevel=3) as file:
        json.dump({"scenario": scenario, "training": training, "held_out": held_out}, file)
    half.replace(kept)


def _of_mission(mission: tuple[Header, int, list[RolloutStep]]) -> list[tuple[str | None, list[Any]]]:
    """A mission's examples, by the suffix of the held-out view; ``None`` for the training."""
    header, number, logged = mission
    views = {None: view_of(number)} if number % HELD_OUT else _HELD_OUT_VIEWS
    return [(suffix, list(map(_plain, prompt_examples(header, logged, view)))) for suffix, view in views.items()]


def _read(kept: Path) -> Examples:
    with gzip.open(kept, "rt", encoding="utf-8") as file:
        found = json.load(file)
    held_out = {name: list(map(_example, examples)) for name, examples in found["held_out"].items()}
    return Examples(found["scenario"], list(map(_example, found["training"])), held_out)


def _example(fields: list[Any]) -> PromptExample:
    text, labels, target, sensors, reference = fields
    return PromptExample(text, labels, np.array(target), tuple(sensors), reference)


def _plain(example: PromptExample) -> list[Any]:
    fields = asdict(example)
    fields["target"] = [round(share, 4) for share in example.target.tolist()]
    return list(fields.values())
