"""The wind: how far a UAV flies at a velocity."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory
from simulator.world.step_noise import StepNoise

# Half of the chord that gives the direction of the way, metres.
_HALF_CHORD_M = 0.5


@dataclass(frozen=True, eq=False)
class Wind:
    """The wind of one world, or of B worlds of one scenario.

    Over a step a UAV of velocity v covers ``v step_s min(2, max(0, 1 + w / max_velocity))``, where w is the wind along
    its way: the mean wind's component in the middle of the way that it would fly in still air, and its gust of the
    step.
    """

    scenario: Scenario
    gusts: StepNoise

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """One world's."""
        return cls(scenario, StepNoise.draw(rng))

    @property
    def blows(self) -> bool:
        """Whether there is any wind."""
        return bool(self.scenario.wind_mps or self.scenario.gust_mps)

    def flown_m(
        self, velocity: IntArray, progress_m: FloatArray, paths: Sequence[Trajectory], instant: int
    ) -> FloatArray:
        """The metres that UAVs ``(..., I)`` at a progress cover in the step that begins at an instant."""
        still = np.asarray(velocity * self.scenario.step_s, dtype=np.float64)
        if not self.blows:
            return still
        along = self.along_mps(progress_m + still / 2, paths) + self.gust_mps(instant, len(paths))
        return np.asarray(still * self._stretch(along))

    def stretch(self, progress_m: FloatArray, paths: Sequence[Trajectory]) -> FloatArray:
        """The metres flown in the mean wind per metre in still air at a progress ``(..., I)``, 0..2."""
        return self._stretch(self.along_mps(progress_m, paths))

    def _stretch(self, along_mps: FloatArray) -> FloatArray:
        return np.asarray(np.clip(1.0 + along_mps / self.scenario.max_velocity, 0.0, 2.0))

    def gust_mps(self, instant: int, uavs: int) -> FloatArray:
        """Each UAV's gust along its way in the step that begins at an instant, ``(I,)`` or ``(B, I)``, m/s."""
        if not self.scenario.gust_mps:
            return np.zeros(uavs)
        return self.scenario.gust_mps * self.gusts.normal(instant, (uavs,))

    def along_mps(self, progress_m: FloatArray, paths: Sequence[Trajectory]) -> FloatArray:
        """The mean wind's component along each UAV's way at a progress ``(..., I)``, m/s."""
        towards = math.radians(self.scenario.wind_from_deg + 180.0)
        east, north = self.scenario.wind_mps * math.sin(towards), self.scenario.wind_mps * math.cos(towards)
        along = np.empty(progress_m.shape)
        for uav, path in enumerate(paths):
            middle = progress_m[..., uav]
            chord = path.at(middle + _HALF_CHORD_M) - path.at(middle - _HALF_CHORD_M)
            # Where a trajectory turns back on itself it has no direction.
            length = np.maximum(np.hypot(chord[..., 0], chord[..., 1]), 1e-9)
            along[..., uav] = (east * chord[..., 0] + north * chord[..., 1]) / length
        return along
