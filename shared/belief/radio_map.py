"""The radio map: the excess of each sensor's path loss over the formula, learned from the gains of its beacons."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from shared.belief.kriging import estimated, invert, predict, take_measurements
from shared.belief.shadowing import (
    EAST,
    EXCESS,
    KINDS,
    MEASURED,
    NOISE,
    NUMBERS,
    ONES,
    PRIOR_DB,
    TAKEN,
    LinkStatistics,
    Measurements,
    likelihoods,
)
from shared.world.channel import FloatArray, IntArray

# Measurements that a map keeps, of all sensors together and of one.
_MOST_KEPT, _MOST_OF_ONE = 4096, 36
# A measurement counts as at most this much, dB: it bounds how far a wrong report moves the map.
LARGEST_EXCESS_DB = 40.0
# Measurements that agree with the formula this closely are no sign of an excess loss, dB.
_EXACT_DB = 0.05
# The map compares the kinds of shadowing again when the measurements have grown by this factor.
_COMPARE_GROWTH = 1.3
_COMPARE_FIRST = 8
# After this many measurements of all sensors, the matrices of the measured sensors are inverted anew. After 10,000
# measurements without that, predictions were off by 3e-9 dB.
_REFRESH = 5000
# The numbers of a measurement's place.
_PLACE = slice(EAST, EXCESS)


class RadioMap:
    """Simple kriging of the excess loss, by sensor and by the UAV's place.

    The excess loss of a sensor is a Gaussian process over the UAV's places: an offset that all links share, plus the
    components of a :class:`shared.belief.shadowing.Shadowing`. The offset, the variance and the kind of shadowing are
    estimated from the measurements of all sensors (empirical Bayes). A measurement far off its prediction is given a
    larger variance.

    Prediction at the place x, with the n measurements r of the sensor, their covariance K and their covariances k(x)
    with the place: mean ``mu + k K^-1 (r - mu)``, variance ``sigma^2 (1 - k K^-1 k)``. A measurement changes one row of
    K, and its inverse by that row (the inverse of a partitioned matrix). K is inverted anew for another kind of
    shadowing, and at intervals, before rounding errors add up.

    Args:
        sensors: J. A map of many sensors keeps fewer measurements of each.

    Attributes:
        count: shape ``(J,)``, measurements kept.
        heard: measurements so far, of all sensors.
        exact: whether every measurement so far agrees with the formula.
        offset_db: ``mu``, dB: the excess that all links share (generalised least squares, shrunk towards 0).
        deviation_db: ``sigma``, dB: the standard deviation of the excess loss of a link that was never measured.
    """

    def __init__(self, sensors: int) -> None:
        kept = int(np.clip(_MOST_KEPT // sensors, 1, _MOST_OF_ONE))
        self._kept: FloatArray = np.zeros((sensors, kept, NUMBERS))
        self.noise[:] = 1.0
        self.count: IntArray = np.zeros(sensors, dtype=np.int64)
        self.heard = 0
        self.kind = KINDS[0]
        self._compared = _COMPARE_FIRST
        self.exact = True
        self.offset_db, self.deviation_db = 0.0, PRIOR_DB
        # K^-1 of each sensor, packed; empty until a gain differs from the formula.
        self._inverse: FloatArray = np.zeros((0, 0))

    @property
    def places(self) -> FloatArray:
        """Shape ``(J, N, 2)``, metres, of the UAVs at the measurements; a view, as the two below."""
        return self._kept[..., _PLACE]

    @property
    def excess(self) -> FloatArray:
        """Shape ``(J, N)``, dB, measured."""
        return np.asarray(self._kept[..., EXCESS])

    @property
    def noise(self) -> FloatArray:
        """Shape ``(J, N)``, the factor of the fading's variance of each measurement, at least 1."""
        return np.asarray(self._kept[..., NOISE])

    def measured_db(self) -> dict[int, float]:
        """The mean excess loss of each measured sensor, dB, over the measurements kept; empty if all are exact."""
        if self.exact:
            return {}
        used = np.arange(self._kept.shape[1]) < self.count[:, None]
        means = (self.excess * used).sum(axis=1) / np.maximum(self.count, 1)
        return {int(sensor): float(means[sensor]) for sensor in np.flatnonzero(self.count)}

    def measure(self, ids: IntArray, place: ArrayLike, excess_db: FloatArray) -> FloatArray:
        """Add one UAV's measurements of n sensors at its place.

        Args:
            ids: shape ``(n,)``, each sensor once.
            place: shape ``(2,)``, metres.
            excess_db: shape ``(n,)``, measured path loss less the formula's, dB.

        Returns:
            the measurements, limited to the largest excess loss.
        """
        # For a few numbers np.clip takes several times as long.
        excess = np.minimum(np.maximum(excess_db, -LARGEST_EXCESS_DB), LARGEST_EXCESS_DB)
        if not len(ids):
            return excess
        self.heard += len(ids)
        if self.exact and np.abs(excess).max() > _EXACT_DB:
            self.exact = False
            self._factor(np.arange(len(self.count)))
        east, north = np.asarray(place, dtype=np.float64).tolist()
        # A copy, because numba would recompile the function for a read-only array.
        take_measurements(self._measurements(), self._links(), np.array(ids), east, north, excess)
        if self.exact:
            self.deviation_db = 0.0
        elif self.heard >= self._compared:
            self._compared = int(np.ceil(self.heard * _COMPARE_GROWTH))
            self._compare()
        elif self.heard % _REFRESH < len(ids):
            self._factor(ids)
        else:
            self._estimate()
        return excess

    def _measurements(self) -> Measurements:
        return Measurements(self._kept, self.count, self._inverse, np.empty((3, self._kept.shape[1])))

    def _links(self) -> LinkStatistics:
        kind = self.kind
        return LinkStatistics(
            kind.sensor, kind.place, kind.range_m, kind.fading, self.offset_db, self.deviation_db, self.heard
        )

    def predict(self, places: FloatArray, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, dB, of the excess loss at places ``(P, 2)`` of sensors ``(n,)``: ``(P, n)``."""
        mean, deviation = np.empty((2, len(places), len(which)))
        work = np.empty((self._kept.shape[1] + 3, len(places)))
        east_north = np.ascontiguousarray(places.T, dtype=np.float64)
        predict(self._measurements(), self._links(), np.array(which), east_north, work, mean, deviation)
        return mean, deviation

    def _factor(self, ids: IntArray) -> None:
        """Invert the covariances of these sensors' measurements, and estimate what all links have in common."""
        if not self._inverse.size:
            most = self._kept.shape[1]
            self._inverse = np.zeros((len(self._kept), most * (most + 1) // 2))
        invert(self._measurements(), self._links(), ids)
        self._estimate()

    def _estimate(self) -> None:
        """The offset and the deviation of all links."""
        self.offset_db, self.deviation_db = estimated(self._kept, self.count)

    def _compare(self) -> None:
        """Choose the kind of shadowing with the highest marginal likelihood, the variance at its estimate."""
        self.kind = KINDS[int(np.argmax(likelihoods(self._kept, self.count)))]
        self._factor(np.flatnonzero(self.count))

    def state_dict(self) -> dict[str, Any]:
        """The measurements and their solutions, as copies."""
        arrays = {name: getattr(self, name).copy() for name in ("places", "excess", "noise", "count")}
        measured, ones = self._kept[..., MEASURED].copy(), self._kept[..., ONES].copy()
        return {
            **arrays,
            "taken": self._kept[..., TAKEN].astype(np.int64),
            "heard": self.heard,
            "kind": KINDS.index(self.kind),
            "compared": self._compared,
            "exact": self.exact,
            "solved": None if not self._inverse.size else [self._inverse.copy(), measured, ones],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``, to the bit."""
        numbers: list[tuple[slice | int, str]] = [
            (_PLACE, "places"),
            (EXCESS, "excess"),
            (NOISE, "noise"),
            (TAKEN, "taken"),
        ]
        self._kept = np.zeros((*state["excess"].shape, NUMBERS))
        for number, name in numbers:
            self._kept[..., number] = state[name]
        self.count = state["count"]
        self.heard, self.kind, self._compared = state["heard"], KINDS[state["kind"]], state["compared"]
        self.exact = state["exact"]
        if state["solved"] is not None:
            self._inverse, self._kept[..., MEASURED], self._kept[..., ONES] = state["solved"]
            self._estimate()
        elif not self.exact:
            self._factor(np.arange(len(self.count)))
        elif self.heard:
            self.deviation_db = 0.0
