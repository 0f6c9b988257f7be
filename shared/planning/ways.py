"""The UAVs' ways to the sensors after a plan's last step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import IntArray


def steps_to(good: NDArray[np.bool_], stride: int, sums: int, fastest: int) -> IntArray:
    """The steps at full speed to the next good place for each sensor, ``(sums, J)``, from velocities' sums 0, 1, ...

    Args:
        good: shape ``(P, J)``, whether a place is good, at the sums 0, ``stride``, ``2 stride``, ...
        stride: between two places, as a sum of velocities.
        sums: C.
        fastest: the velocity.

    Returns:
        the steps; more than any way has if no good place follows.
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
