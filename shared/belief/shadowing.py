"""Shadowing: the covariance of the excess losses of one sensor's links at several places; each kind's likelihood."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray

# The prior of the excess loss's standard deviation, dB, and its weight in measurements. A low weight: the first report
# of a world that equals the formula shows that it does.
PRIOR_DB, PRIOR_WEIGHT = 6.0, 0.03
# The weight of the prior of the offset that all links share, an offset of 0 dB, in independent sensors.
OFFSET_WEIGHT = 2.0
# The numbers of a measurement: the UAV's place, the excess loss, the noise and when it was taken, and its entries of
# K^-1 r and K^-1 1.
EAST, NORTH, EXCESS, NOISE, TAKEN, MEASURED, ONES, NUMBERS = range(8)


@dataclass(frozen=True)
class Shadowing:
    """A kind of shadowing, as shares of the excess loss's variance that sum to 1.

    ``sensor``: the same at every place. ``place``: by the UAV's place, with the correlation
    ``exp(-distance / range_m)`` (Gudmundson 1991). The rest, ``fading``, differs from step to step.
    """

    sensor: float
    place: float
    range_m: float

    @cached_property
    def fading(self) -> float:
        """The share of the variance that earlier measurements cannot explain."""
        return 1.0 - self.sensor - self.place


# The measurements' likelihood selects one of them; the first is the prior assumption.
KINDS = (
    Shadowing(sensor=0.4, place=0.4, range_m=60.0),
    *(
        Shadowing(sensor=sensor * (1 - fading), place=(1 - sensor) * (1 - fading), range_m=range_m)
        for sensor in (0.2, 0.6)
        for range_m in (50.0, 150.0)
        for fading in (0.02, 0.2)
    ),
    # Mainly a sensor's own excess, and mainly fading.
    Shadowing(sensor=0.996, place=0.002, range_m=60.0),
    Shadowing(sensor=0.9, place=0.08, range_m=60.0),
    Shadowing(sensor=0.4, place=0.2, range_m=60.0),
    Shadowing(sensor=0.05, place=0.05, range_m=60.0),
)


class Measurements(NamedTuple):
    """The measurements of J sensors, at most N of each.

    Attributes:
        kept: shape ``(J, N, 7)``, the numbers of each.
        counts: shape ``(J,)``, how many a sensor has.
        inverse: ``K^-1`` of each sensor, shape ``(J, N (N + 1) / 2)``: the upper triangle column by column, in half the
            memory, so that a leading block comes first; zeros where there is no measurement. ``(0, 0)`` as long as
            every measurement agrees with the formula.
        work: shape ``(3, N)``, any numbers.
    """

    kept: FloatArray
    counts: IntArray
    inverse: FloatArray
    work: FloatArray


class LinkStatistics(NamedTuple):
    """The statistics of all links.

    The first four are of the kind of :class:`~shared.belief.shadowing.Shadowing`, ``offset_db`` and ``deviation_db``
    ``mu`` and ``sigma``; ``heard`` counts the measurements of all sensors so far.
    """

    sensor: float
    place: float
    range_m: float
    fading: float
    offset_db: float
    deviation_db: float
    heard: int


# The shares of each kind's variance, and the ranges, each once.
_SENSOR, _PLACE, _FADING = (np.array([getattr(kind, name) for kind in KINDS]) for name in ("sensor", "place", "fading"))
_RANGES_M, _RANGE_OF_KIND = np.unique([kind.range_m for kind in KINDS], return_inverse=True)


def likelihoods(kept: FloatArray, counts: IntArray) -> FloatArray:
    """The log marginal likelihood of the measurements by each of ``KINDS``, without a constant.

    The variance is at its estimate. With ``L L^T = K``, of each sensor, the sums of squares are of ``L^-1 r`` and of
    ``L^-1 1``, and ``log det K`` is twice the sum of the logarithms of L's diagonal.

    Args:
        kept, counts: as :class:`~shared.belief.shadowing.Measurements` has them.
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
