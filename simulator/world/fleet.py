"""A fleet on its trajectories: the start and the progress of each UAV."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories


@dataclass(frozen=True, eq=False)
class Fleet:
    """I UAVs, each on its trajectory; of B worlds both arrays have a first dimension B.

    Attributes:
        trajectories: one a UAV.
        start_m: shape ``(I,)``, arc length from each trajectory's beginning to the UAV's start.
        progress_m: shape ``(I,)``, ``start_m`` plus the distance flown.
    """

    trajectories: tuple[Trajectory, ...]
    start_m: FloatArray
    progress_m: FloatArray

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """A scenario's fleet, each start uniform along its trajectory."""
        paths = trajectories(scenario)
        start_m = rng.uniform(0.0, 1.0, len(paths)) * [path.length_m for path in paths]
        return cls(paths, start_m, start_m)

    @property
    def positions(self) -> FloatArray:
        """The UAVs' current positions, shape ``(I, 2)``, metres."""
        return self.at(self.progress_m)

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """The UAVs' positions at arc lengths ``(..., I)`` along their trajectories, ``(..., I, 2)``, metres."""
        progress = np.asarray(progress_m, dtype=np.float64)
        return np.stack([path.at(progress[..., uav]) for uav, path in enumerate(self.trajectories)], axis=-2)
