"""How near modules come to a teacher: whether attention keeps its sensor, and whether they would fly as fast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.learning.modules import Weights, top_k
from service.training.rollout_examples import Example, Taught


def references(examples: Sequence[Example]) -> dict[str, list[Taught]]:
    """By teacher, the references whose sensor can send something."""
    found: dict[str, list[Taught]] = {}
    for taught in (example.taught for example in examples if example.taught is not None):
        if taught.reaches:
            found.setdefault(taught.teacher, []).append(taught)
    return dict(sorted(found.items()))


def recall(weights: Weights, references: Sequence[Taught], k: int) -> float:
    """How often the teacher's sensor is among the k best scored, of the decisions with more than k candidates."""
    hits = [
        taught.sample.chosen in top_k(weights.score(taught.sample.features)[0], k)
        for taught in references
        if len(taught.sample.features) > k
    ]
    return float(np.mean(hits)) if hits else float("nan")


def velocity_error(weights: Weights, references: Sequence[Taught]) -> float:
    """Mean difference from the teacher's velocity, m/s, of the velocity valued highest for the teacher's sensor."""
    return float(np.mean([abs(_fastest(weights, taught) - taught.sample.velocity) for taught in references]))


def velocity_agreement(weights: Weights, references: Sequence[Taught]) -> float:
    """How often the velocity valued highest for the teacher's sensor is the teacher's."""
    return float(np.mean([_fastest(weights, taught) == taught.sample.velocity for taught in references]))


def _fastest(weights: Weights, taught: Taught) -> int:
    sample = taught.sample
    _, z = weights.score(sample.features)
    return int(weights.velocities(z[sample.chosen], sample.approach).argmax())
