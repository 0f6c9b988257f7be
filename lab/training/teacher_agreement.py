"""The agreement of modules with a teacher: on the sensors that attention keeps, and on the velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.training.rollout_examples import Example, TeacherDecision
from service.learning.modules import Weights, top_k


def references(examples: Sequence[Example]) -> dict[str, list[TeacherDecision]]:
    """The references whose sensor can send something, by teacher."""
    found: dict[str, list[TeacherDecision]] = {}
    for taught in (example.taught for example in examples if example.taught is not None):
        if taught.reaches:
            found.setdefault(taught.teacher, []).append(taught)
    return dict(sorted(found.items()))


def recall(weights: Weights, references: Sequence[TeacherDecision], k: int) -> float:
    """The share of decisions with the teacher's sensor among the k best, of those with more than k candidates."""
    hits = [
        taught.sample.chosen in top_k(weights.attend(taught.sample.features).scores, k)
        for taught in references
        if len(taught.sample.features) > k
    ]
    return float(np.mean(hits)) if hits else float("nan")


def velocity_error(weights: Weights, references: Sequence[TeacherDecision]) -> float:
    """The mean distance, in m/s, of the velocity valued highest for the teacher's sensor from the teacher's."""
    return float(np.mean([abs(_best_velocity(weights, taught) - taught.sample.velocity) for taught in references]))


def velocity_agreement(weights: Weights, references: Sequence[TeacherDecision]) -> float:
    """The share of decisions where the velocity valued highest for the teacher's sensor is the teacher's."""
    return float(np.mean([_best_velocity(weights, taught) == taught.sample.velocity for taught in references]))


def _best_velocity(weights: Weights, taught: TeacherDecision) -> int:
    sample = taught.sample
    contexts = weights.attend(sample.features).contexts([sample.chosen])
    return int(weights.velocities(contexts, sample.approach[None])[0].argmax())
