"""Random numbers of an instant of a world, which do not depend on the time and order of the calls."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shared.world.channel import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Normal numbers by instant, of one world or of B worlds: ``keys`` are their seeds, ``()`` or ``(B,)``."""

    keys: IntArray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """One world's."""
        return cls(np.asarray(rng.integers(2**63)))

    def normal(self, instant: int, shape: tuple[int, ...]) -> FloatArray:
        """Standard normal numbers of an instant, of that shape, or ``(B, *shape)``; one shape only, at one instant."""
        keys = self.keys.ravel().tolist()
        drawn = [np.random.default_rng([key, instant]).standard_normal(shape) for key in keys]
        return np.stack(drawn).reshape(*self.keys.shape, *shape)
