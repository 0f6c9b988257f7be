"""Shadowing: how the excess losses of one sensor's links at several places belong together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray

# The prior of the excess loss's standard deviation, dB, and its weight in measurements. A low weight: the first report
# of a world that equals the formula shows that it does.
PRIOR_DB, PRIOR_WEIGHT = 6.0, 0.03
# The weight of the prior of the offset that all links share, an offset of 0 dB, in independent sensors.
OFFSET_WEIGHT = 2.0


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
        """The share of the variance that no earlier measurement tells anything about."""
        return 1.0 - self.sensor - self.place

    def covariance(self, apart_m: FloatArray) -> FloatArray:
        """The covariance of two measurements of one sensor at places this far apart, without the fading."""
        return self.sensor + self.place * np.exp(-apart_m / self.range_m)

    def covariances(self, apart_m: FloatArray, used: NDArray[np.bool_], noise: FloatArray) -> FloatArray:
        """The covariances ``K`` of n sensors' measurements, ``(n, kept, kept)``; arguments as of :func:`likelihoods`.

        The rows without a measurement are the identity's.
        """
        places = np.arange(used.shape[1])
        matrices = self.covariance(apart_m) * (used[:, :, None] & used[:, None, :])
        matrices[:, places, places] = np.where(used, 1.0 + self.fading * (noise - 1.0), 1.0)
        return np.asarray(matrices)


# The likelihood of the measurements chooses between them. The first is the assumption before.
KINDS = (
    Shadowing(sensor=0.4, place=0.4, range_m=60.0),
    *(
        Shadowing(sensor=sensor * (1 - fading), place=(1 - sensor) * (1 - fading), range_m=range_m)
        for sensor in (0.2, 0.6)
        for range_m in (50.0, 150.0)
        for fading in (0.02, 0.2)
    ),
    # A sensor's own excess alone, and fading alone.
    Shadowing(sensor=0.996, place=0.002, range_m=60.0),
    Shadowing(sensor=0.9, place=0.08, range_m=60.0),
    Shadowing(sensor=0.4, place=0.2, range_m=60.0),
    Shadowing(sensor=0.05, place=0.05, range_m=60.0),
)
# The kinds' shares, as columns for arrays (kinds, n, kept, kept), and their ranges, each once.
_SENSOR_SHARES = np.array([kind.sensor for kind in KINDS])[:, None, None, None]
_PLACE_SHARES = np.array([kind.place for kind in KINDS])[:, None, None, None]
_FADINGS = np.array([kind.fading for kind in KINDS])[:, None, None]
_RANGES_M, _RANGE_OF_KIND = np.unique([kind.range_m for kind in KINDS], return_inverse=True)
_RANGES_M = _RANGES_M[:, None, None, None]


def likelihoods(apart_m: FloatArray, used: NDArray[np.bool_], excess: FloatArray, noise: FloatArray) -> FloatArray:
    """The log marginal likelihood of n sensors' measurements by each of ``KINDS``, without a constant.

    The variance is at its estimate. One array has all kinds' matrices: thirteen times as many small operations would
    take several times as long.

    Args:
        apart_m: shape ``(n, kept, kept)``, metres between the places of a sensor's measurements.
        used: shape ``(n, kept)``, whether there is a measurement.
        excess: shape ``(n, kept)``, dB; 0 where there is none.
        noise: shape ``(n, kept)``, the factor of the fading's variance.
    """
    places = np.arange(used.shape[1])
    # (kinds, n, kept, kept)
    matrices = _SENSOR_SHARES + _PLACE_SHARES * np.exp(-apart_m / _RANGES_M)[_RANGE_OF_KIND]
    matrices *= used[:, :, None] & used[:, None, :]
    matrices[..., places, places] = np.where(used, 1.0 + _FADINGS * (noise - 1.0), 1.0)
    solved = np.linalg.solve(matrices, np.stack((excess, used.astype(np.float64)), axis=2))
    measured, ones = solved[..., 0], solved[..., 1]
    offset = measured.sum(axis=(1, 2)) / (ones.sum(axis=(1, 2)) + OFFSET_WEIGHT)
    squares = (excess - offset[:, None, None]) * (measured - offset[:, None, None] * ones)
    count = float(used.sum())
    total = PRIOR_WEIGHT * PRIOR_DB**2 + np.maximum((squares * used).sum(axis=(1, 2)), 0.0)
    spread = np.linalg.slogdet(matrices)[1].sum(axis=1)
    return np.asarray(-0.5 * count * np.log(total / (PRIOR_WEIGHT + count)) - 0.5 * spread)
