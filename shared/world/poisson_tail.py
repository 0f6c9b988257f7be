"""The upper tail of a Poisson distribution, compiled: how likely more packets arrive than a queue has room for."""

from __future__ import annotations

import math

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray

# The probability of no packet at this mean is still far from the smallest number.
_SMALL_MEAN = 600.0


@compiled
def above_poisson(room: FloatArray, mean: FloatArray, above: FloatArray) -> None:
    """Write ``P(Poisson(mean) > room)``: one minus the sum of the probabilities of 0 to ``room`` packets.

    Args:
        room: whole numbers from 0, shape ``(n,)``.
        mean: packets, at least 0, shape ``(n,)``.
        above: shape ``(n,)``, is written.
    """
    for i in range(len(room)):
        total = 0.0
        if mean[i] < _SMALL_MEAN:
            probability = math.exp(-mean[i])
            total = probability
            for packets in range(1, int(room[i]) + 1):
                probability *= mean[i] / packets
                total += probability
        else:
            logarithm = -mean[i]
            for packets in range(1, int(room[i]) + 1):
                logarithm += math.log(mean[i] / packets)
                total += math.exp(logarithm)
        above[i] = min(max(1.0 - total, 0.0), 1.0)
