"""What a plan leaves behind: the losses after its horizon, by the places where it leaves the UAVs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Afterwards:
    """The losses after a horizon of H steps, by the way of the nearest UAV to each sensor.

    Attributes:
        stages: by UAV, shape ``(C, J)``: after velocities that sum to c, 0..K - 1, higher the more steps the UAV needs
            to each sensor. The lowest of all UAVs counts.
        risk: shape ``(K, H + 1, J)``: ``risk[k, s]`` is each sensor's expected loss after the horizon at stage k if no
            UAV has visited it since step s began. Never less at a higher stage.
    """

    stages: Sequence[IntArray]
    risk: FloatArray

    def stage(self, flown: IntArray) -> IntArray:
        """Each sensor's stage, ``(J,)``, after velocities that sum to ``(I,)``."""
        tables = [table[summed] for table, summed in zip(self.stages, flown.tolist(), strict=True)]
        return np.asarray(np.min(tables, axis=0))


def steps_to(good: NDArray[np.bool_], stride: int, sums: int, fastest: int) -> IntArray:
    """The steps at full speed to the next good place for each sensor, ``(sums, J)``, from velocities' sums 0, 1, ...

    Args:
        good: shape ``(P, J)``, whether a place is good, at the sums 0, ``stride``, ``2 stride``, ...
        stride: between two places, as a sum of velocities.
        sums: C.
        fastest: the velocity.

    Returns:
        more steps than any way has, where no good place follows.
    """
    count = len(good)
    place = np.where(good, np.arange(count)[:, None], _NOWHERE)
    following = np.minimum.accumulate(place[::-1], axis=0)[::-1]
    summed = np.arange(sums)
    here = np.minimum(-(-summed // stride), count - 1)
    way = following[here] * stride - summed[:, None]
    return np.asarray(-(-np.maximum(way, 0) // fastest))


# The index of a place that does not exist.
_NOWHERE = 10**9
