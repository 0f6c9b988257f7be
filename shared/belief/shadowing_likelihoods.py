"""The likelihoods of the kinds of shadowing for a radio map, compiled as :mod:`shared.belief.kriging` is."""

import math

import numpy as np

from shared.belief.radio_map_arrays import EAST, EXCESS, NOISE, NORTH
from shared.belief.shadowing import KINDS, OFFSET_WEIGHT, PRIOR_DB, PRIOR_WEIGHT
from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray

# The shares of each kind's variance, and the ranges, each once.
_SENSOR, _PLACE, _FADING = (np.array([getattr(kind, name) for kind in KINDS]) for name in ("sensor", "place", "fading"))
_RANGES_M, _RANGE_OF_KIND = np.unique([kind.range_m for kind in KINDS], return_inverse=True)


def likelihoods(kept: FloatArray, counts: IntArray) -> FloatArray:
    """The log marginal likelihood of the measurements by each of ``KINDS``, without a constant.

    The variance is at its estimate. With ``L L^T = K``, of each sensor, the sums of squares are of ``L^-1 r`` and of
    ``L^-1 1``, and ``log det K`` is twice the sum of the logarithms of L's diagonal.

    Args:
        kept, counts: as :class:`~shared.belief.radio_map_arrays.Measurements` has them.
    """
    most, kinds = int(counts.max(initial=0)), len(KINDS)
    factor, solved = np.empty((most, most, kinds)), np.empty((2, most, kinds))
    sums, decays = np.zeros((4, kinds)), np.empty(len(_RANGES_M))
    shares = np.stack((_SENSOR, _PLACE, _FADING))
    _sum(kept, counts, shares, _RANGES_M, _RANGE_OF_KIND, factor, solved, decays, sums)
    squares, both, ones, spread = sums
    offset = both / (ones + OFFSET_WEIGHT)
    off = squares - 2.0 * offset * both + np.square(offset) * ones
    total = PRIOR_WEIGHT * PRIOR_DB**2 + np.maximum(off, 0.0)
    number = float(counts.sum())
    return np.asarray(-0.5 * number * np.log(total / (PRIOR_WEIGHT + number)) - 0.5 * spread)


@compiled
def _sum(
    kept: FloatArray,
    counts: IntArray,
    shares: FloatArray,
    ranges_m: FloatArray,
    range_of_kind: IntArray,
    factor: FloatArray,
    solved: FloatArray,
    decays: FloatArray,
    sums: FloatArray,
) -> None:
    """Add up ``r K^-1 r``, ``r K^-1 1``, ``1 K^-1 1`` and ``log det K`` over the sensors, by kind ``(4, K)``.

    The innermost loops are over the K kinds, whose numbers the processor computes several at a time.

    Args:
        factor, solved, decays: any numbers, ``(N, N, K)``, ``(2, N, K)`` and one for each range.
    """
    kinds = shares.shape[1]
    for sensor in range(kept.shape[0]):
        for n in range(counts[sensor]):
            own = kept[sensor, n]
            for k in range(kinds):
                factor[n, n, k] = 1.0 + shares[2, k] * (own[NOISE] - 1.0)
                solved[0, n, k], solved[1, n, k] = own[EXCESS], 1.0
            for r in range(n):
                other = kept[sensor, r]
                apart = math.sqrt((own[EAST] - other[EAST]) ** 2 + (own[NORTH] - other[NORTH]) ** 2)
                for i in range(ranges_m.shape[0]):
                    decays[i] = math.exp(-apart / ranges_m[i])
                for k in range(kinds):
                    factor[n, r, k] = shares[0, k] + shares[1, k] * decays[range_of_kind[k]]
                for c in range(r):
                    for k in range(kinds):
                        factor[n, r, k] -= factor[n, c, k] * factor[r, c, k]
                for k in range(kinds):
                    factor[n, r, k] /= factor[r, r, k]
                    factor[n, n, k] -= factor[n, r, k] ** 2
                    solved[0, n, k] -= factor[n, r, k] * solved[0, r, k]
                    solved[1, n, k] -= factor[n, r, k] * solved[1, r, k]
            for k in range(kinds):
                square = factor[n, n, k]
                factor[n, n, k] = math.sqrt(square)
                solved[0, n, k] /= factor[n, n, k]
                solved[1, n, k] /= factor[n, n, k]
                sums[0, k] += solved[0, n, k] ** 2
                sums[1, k] += solved[0, n, k] * solved[1, n, k]
                sums[2, k] += solved[1, n, k] ** 2
                sums[3, k] += math.log(square)
