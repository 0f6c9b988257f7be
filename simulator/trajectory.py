"""Trajectories: every UAV flies counter-clockwise laps of a circle of its own."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from shared.channel import FloatArray
from shared.scenario import Scenario


class Laps:
    """The circles of a fleet of I UAVs, and how far along its own each UAV is.

    Attributes:
        centres: shape ``(I, 2)``, metres.
        radius_m: of every circle.
        start_angle: shape ``(I,)``, radians, counter-clockwise from due east.
        travelled_m: shape ``(I,)``, arc length flown since the start.

    Raises:
        ValueError: the radius is not positive, or the shapes do not agree.
    """

    def __init__(self, centres: ArrayLike, radius_m: float, start_angle: ArrayLike) -> None:
        self.centres: FloatArray = np.array(centres, dtype=np.float64)
        self.radius_m = float(radius_m)
        self.start_angle: FloatArray = np.array(start_angle, dtype=np.float64)
        if not self.radius_m > 0:
            raise ValueError(f"radius_m is {radius_m}, must be above 0")
        if self.centres.ndim != 2 or self.centres.shape != (len(self.start_angle), 2):
            raise ValueError(f"centres have shape {self.centres.shape}, start_angle {self.start_angle.shape}")
        self.travelled_m: FloatArray = np.zeros(len(self.start_angle))

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """A scenario's laps with start angles uniform in 0..2 pi."""
        return cls(scenario.lap_centres, scenario.lap_radius_m, rng.uniform(0.0, 2.0 * np.pi, scenario.uavs))

    @property
    def positions(self) -> FloatArray:
        """Where the UAVs are now, shape ``(I, 2)``, metres."""
        return self.at(self.travelled_m)

    def at(self, travelled_m: ArrayLike) -> FloatArray:
        """Where the UAVs are after an arc length from their starts.

        Args:
            travelled_m: shape ``(..., I)`` or anything that broadcasts to it, metres.

        Returns:
            ``centre + radius (cos, sin)(start + travelled / radius)``, shape ``(..., I, 2)``, metres.
        """
        return self.at_angle(self.start_angle + np.asarray(travelled_m, dtype=np.float64) / self.radius_m)

    def at_angle(self, angle: ArrayLike) -> FloatArray:
        """The points of the circles at angles ``(..., I)`` in radians, shape ``(..., I, 2)``, metres."""
        turn = np.broadcast_to(angle, np.broadcast_shapes(np.shape(angle), self.start_angle.shape))
        return self.centres + self.radius_m * np.stack((np.cos(turn), np.sin(turn)), axis=-1)

    def advance(self, distance_m: ArrayLike) -> FloatArray:
        """Fly on by a distance, and return the new positions.

        Args:
            distance_m: arc lengths, shape ``(I,)`` or a scalar for all, metres, at least 0.

        Raises:
            ValueError: a distance is negative or not finite.
        """
        distance = np.asarray(distance_m, dtype=np.float64)
        if not np.all(np.isfinite(distance) & (distance >= 0)):
            raise ValueError(f"distance_m is {distance_m!r}, must be finite and at least 0")
        self.travelled_m = self.travelled_m + distance
        return self.positions
