"""A fleet on its trajectories: the start and the progress of each UAV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories


class Fleet:
    """I UAVs, each on its trajectory.

    Attributes:
        trajectories: one a UAV.
        start_m: shape ``(I,)``, arc length from each trajectory's beginning to the UAV's start.
        progress_m: shape ``(I,)``, ``start_m`` plus the distance flown.

    Raises:
        ValueError: the number of starts is not that of the trajectories.
    """

    def __init__(self, paths: Sequence[Trajectory], start_m: ArrayLike) -> None:
        self.trajectories = tuple(paths)
        self.start_m: FloatArray = np.array(start_m, dtype=np.float64)
        if self.start_m.shape != (len(self.trajectories),):
            raise ValueError(f"{len(self.trajectories)} trajectories, start_m has shape {self.start_m.shape}")
        self.progress_m = self.start_m

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """A scenario's fleet, each start uniform along its trajectory."""
        paths = trajectories(scenario)
        return cls(paths, rng.uniform(0.0, 1.0, len(paths)) * [path.length_m for path in paths])

    @property
    def positions(self) -> FloatArray:
        """The UAVs' current positions, shape ``(I, 2)``, metres."""
        return self.at(self.progress_m)

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """The UAVs' positions at arc lengths ``(..., I)`` along their trajectories, ``(..., I, 2)``, metres."""
        progress = np.asarray(progress_m, dtype=np.float64)
        return np.stack([path.at(progress[..., uav]) for uav, path in enumerate(self.trajectories)], axis=-2)

    def advance(self, distance_m: ArrayLike) -> FloatArray:
        """Advance each UAV by a distance, and return the new positions.

        Args:
            distance_m: arc lengths, shape ``(I,)`` or a scalar for all, metres, at least 0.

        Raises:
            ValueError: a distance is negative or not finite.
        """
        distance = np.asarray(distance_m, dtype=np.float64)
        if not np.all(np.isfinite(distance) & (distance >= 0)):
            raise ValueError(f"distance_m is {distance_m!r}, must be finite and at least 0")
        self.progress_m = self.progress_m + distance
        return self.positions
