"""What makes a training the one it is; without torch, so that a command can refuse bad use at once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from shared.scenario import Scenario
from simulator.sites.training_seeds import FIRST_TRAINING_SEED

# The file in a training's folder to resume from.
STATE = "state.pt"
MOST_EPISODES = 1_000_000


@dataclass(frozen=True)
class Plan:
    """What makes a training the one it is: the same plan gives the same weights, to the bit, on the same machine."""

    scheme: str
    scenario: Scenario
    episodes: int
    seed: int
    threads: int

    @property
    def first_seed(self) -> int:
        """Of the training worlds; no two trainings, nor a training and an evaluation, share a world."""
        return FIRST_TRAINING_SEED + (self.seed + 1) * MOST_EPISODES

    def told(self) -> dict[str, Any]:
        """As plain values."""
        return {**asdict(self), "scenario": self.scenario.model_dump_json()}
