"""The identity of a training; without torch, so that a command can refuse unusable options at once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from lab.training_seeds import FIRST_TRAINING_SEED
from shared.world.scenario import Scenario

# The file in a training's folder from which it resumes.
STATE = "state.pt"
MOST_EPISODES = 1_000_000


@dataclass(frozen=True)
class TrainingPlan:
    """The inputs of a training: the same plan gives the same weights to the bit on the same machine."""

    scheme: str
    scenario: Scenario
    episodes: int
    seed: int
    threads: int

    @property
    def first_seed(self) -> int:
        """The first seed of the training worlds; two trainings share no world, nor do a training and an evaluation."""
        return FIRST_TRAINING_SEED + (self.seed + 1) * MOST_EPISODES

    def plain(self) -> dict[str, Any]:
        """The fields as plain values."""
        return {**asdict(self), "scenario": self.scenario.model_dump_json()}
