"""Random numbers that belong to an instant of a world: the same whenever and in whatever order they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from shared.world.channel import FloatArray


@dataclass(frozen=True)
class StepNoise:
    """One world's normal numbers by instant, or those of B worlds.

    Attributes:
        keys: the seed of each world's numbers.
        stacked: whether the numbers of several worlds are asked for, along a first dimension.
    """

    keys: tuple[int, ...]
    stacked: bool = False

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """One world's."""
        return cls((int(rng.integers(2**63)),))

    @classmethod
    def stack(cls, worlds: Sequence[StepNoise]) -> Self:
        """The numbers of B worlds."""
        return cls(tuple(key for world in worlds for key in world.keys), stacked=True)

    def normal(self, instant: int, shape: tuple[int, ...]) -> FloatArray:
        """Standard normal numbers of an instant, of that shape, or ``(B, *shape)``; one shape only, at one instant."""
        drawn = [np.random.default_rng([key, instant]).standard_normal(shape) for key in self.keys]
        return np.stack(drawn) if self.stacked else drawn[0]
