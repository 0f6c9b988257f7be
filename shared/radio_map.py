"""The radio map: the excess of each sensor's path loss over the formula, learned from the gains of its beacons."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.channel import FloatArray, IntArray
from shared.shadowing import KINDS, OFFSET_WEIGHT, PRIOR_DB, PRIOR_WEIGHT, likelihoods

# Measurements that a map keeps, of all sensors together and of one.
_MOST_KEPT, _MOST_OF_ONE = 4096, 36
# A measurement counts as at most this much, dB: it bounds how far a wrong report moves the map.
LARGEST_EXCESS_DB = 40.0
# A measurement this many standard deviations off its prediction counts less, as in Huber's estimator.
_HUBER = 3.0
_HUBER_LEAST_DB = 1.0
# Measurements that agree with the formula this closely are no sign of an excess loss, dB.
_EXACT_DB = 0.05
# The map compares its kinds of shadowing again when this factor more measurements came.
_COMPARE_GROWTH = 1.3
_COMPARE_FIRST = 8
# After so many measurements of all sensors, those of the sensors at hand are inverted anew.
_REFRESH = 500
# Measurements of a sensor within this distance are of the same place, metres; so many of one place are kept.
_SAME_PLACE_M, _MOST_OF_PLACE = 10.0, 2


# A measurement's numbers: the UAV's place, the excess loss, the noise and when it was taken (``heard`` then), and its
# entries of K^-1 r and K^-1 1. One array has them all, because indexing costs more than the sums of a few sensors.
_PLACE, _EXCESS, _NOISE, _TAKEN, _MEASURED, _ONES, _NUMBERS = slice(0, 2), 2, 3, 4, 5, 6, 7
# A packed symmetric matrix has its upper triangle column by column, in half the memory, so that a leading block of it
# comes first. By row and column, the place in it.
_ROWS, _COLUMNS = np.tril_indices(_MOST_OF_ONE)[::-1]
_PLACE_IN_PACKED = np.zeros((_MOST_OF_ONE, _MOST_OF_ONE), dtype=np.int64)
_PLACE_IN_PACKED[_ROWS, _COLUMNS] = _PLACE_IN_PACKED[_COLUMNS, _ROWS] = np.arange(len(_ROWS))


@cache
def _packing(kept: int) -> tuple[IntArray, IntArray]:
    """Places of a square matrix's entries in the packed one, ``(kept * kept,)``, and of the packed ones in it."""
    few = kept * (kept + 1) // 2
    return _PLACE_IN_PACKED[:kept, :kept].ravel(), _ROWS[:few] * kept + _COLUMNS[:few]


class RadioMap:
    """Simple kriging of the excess loss, by sensor and by the UAV's place.

    The excess loss of a sensor is a Gaussian process over the UAV's places: an offset that all links share, plus the
    components of a :class:`shared.shadowing.Shadowing`. The offset, the variance and the kind of shadowing are
    estimated from the measurements of all sensors (empirical Bayes). A measurement far off its prediction is given a
    larger variance.

    Prediction at the place x, with the n measurements r of the sensor, their covariance K and their covariances k(x)
    with the place: mean ``mu + k K^-1 (r - mu)``, variance ``sigma^2 (1 - k K^-1 k)``. A measurement changes one row of
    K, and its inverse by that row (the inverse of a partitioned matrix). Another kind of shadowing inverts K anew, and
    so does every so many measurements, before rounding errors add up.

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
        self._kept: FloatArray = np.zeros((sensors, kept, _NUMBERS))
        self.noise[:] = 1.0
        self.count: IntArray = np.zeros(sensors, dtype=np.int64)
        self.heard = 0
        self.kind = KINDS[0]
        self._compared = _COMPARE_FIRST
        self.exact = True
        self.offset_db, self.deviation_db = 0.0, PRIOR_DB
        # K^-1 of each sensor, packed, with zeros where it has no measurement. None until a gain differs from the
        # formula.
        self._inverse: FloatArray | None = None

    @property
    def places(self) -> FloatArray:
        """Shape ``(J, N, 2)``, metres, of the UAVs at the measurements; a view, as the two below."""
        return self._kept[..., _PLACE]

    @property
    def excess(self) -> FloatArray:
        """Shape ``(J, N)``, dB, measured."""
        return np.asarray(self._kept[..., _EXCESS])

    @property
    def noise(self) -> FloatArray:
        """Shape ``(J, N)``, the factor of the fading's variance of each measurement, at least 1."""
        return np.asarray(self._kept[..., _NOISE])

    def measured_db(self) -> dict[int, float]:
        """The mean excess loss of each measured sensor, dB, over the measurements kept; empty if all are exact."""
        if self.exact:
            return {}
        used = np.arange(self._kept.shape[1]) < self.count[:, None]
        means = (self.excess * used).sum(axis=1) / np.maximum(self.count, 1)
        return {int(sensor): float(means[sensor]) for sensor in np.flatnonzero(self.count)}

    def measure(self, ids: IntArray, place: ArrayLike, excess_db: FloatArray) -> FloatArray:
        """Take one UAV's measurements of n sensors at its place.

        Args:
            ids: shape ``(n,)``, each sensor once.
            place: shape ``(2,)``, metres.
            excess_db: shape ``(n,)``, measured path loss less the formula's, dB.

        Returns:
            the measurements as they count: within the largest excess loss.
        """
        # For a few numbers np.clip takes several times as long.
        excess = np.minimum(np.maximum(excess_db, -LARGEST_EXCESS_DB), LARGEST_EXCESS_DB)
        if not len(ids):
            return excess
        self.heard += len(ids)
        if self.exact and np.abs(excess).max() > _EXACT_DB:
            self.exact = False
            self._factor(np.arange(len(self.count)))
        count = self.count.take(ids)
        # One more than a sensor has, for a new one.
        size = min(int(count.max()) + 1, self._kept.shape[1])
        kept = self._kept.take(ids, 0)[:, :size]
        new = np.empty((len(ids), _NUMBERS))
        new[:, _PLACE], new[:, _EXCESS], new[:, _NOISE], new[:, _TAKEN] = place, excess, 1.0, self.heard
        east, north = kept[:, :, 0] - new[:, :1], kept[:, :, 1] - new[:, 1:2]
        apart = east * east + north * north
        slot, dropped = _slots(kept, count, apart, self._kept.shape[1], self.heard)
        inverse = None if self.exact else self._replace(kept, new, slot, dropped, self._inverses(ids, size), apart)
        kept[np.arange(len(ids)), slot] = new
        self.count[ids] += ~dropped
        due = not self.exact and (self.heard >= self._compared or self.heard % _REFRESH < len(ids))
        if inverse is not None and not due:
            kept[:, :, _MEASURED:] = _solved(inverse, kept)
        self._kept[ids, :size] = kept
        self._learn(ids, inverse, due)
        return excess

    def _learn(self, ids: IntArray, inverse: FloatArray | None, due: bool) -> None:
        """Estimate what all links have in common, after new measurements of these sensors with this ``K^-1``."""
        if inverse is None:
            self.deviation_db = 0.0
        elif not due:
            self._pack(ids, inverse)
            self._estimate()
        elif self.heard >= self._compared:
            self._compared = int(np.ceil(self.heard * _COMPARE_GROWTH))
            self._compare()
        else:
            self._factor(ids)

    def _replace(
        self,
        kept: FloatArray,
        new: FloatArray,
        slot: IntArray,
        dropped: NDArray[np.bool_],
        inverse: FloatArray,
        apart: FloatArray,
    ) -> FloatArray:
        """``K^-1`` with new measurements ``(n, 7)`` in these slots, whose noise is set by the prediction before them.

        Args:
            apart: shape ``(n, size)``, squared distances of the kept measurements from the new ones, square metres.
        """
        rows, fading = np.arange(len(kept)), self.kind.fading
        covariance = self.kind.covariance(np.sqrt(apart))
        left = kept[:, :, _MEASURED] - self.offset_db * kept[:, :, _ONES]
        known = (covariance[:, None] @ inverse)[:, 0]
        share = np.maximum(1.0 - (known * covariance).sum(axis=1), fading)
        deviation = np.maximum(self.deviation_db * np.sqrt(share), _HUBER_LEAST_DB)
        off = np.abs(new[:, _EXCESS] - self.offset_db - (covariance * left).sum(axis=1)) / deviation
        noise = new[:, _NOISE] = np.square(np.maximum(off / _HUBER, 1.0))
        if dropped.any():
            # Without the measurements that leave their slots.
            own = inverse[rows, slot]
            weight = own[rows, slot]
            own /= np.sqrt(np.where(weight > 0, weight, 1.0))[:, None]
            inverse -= own[:, :, None] * own[:, None, :]
            inverse[rows, slot], inverse[rows, :, slot] = 0.0, 0.0
            known = (covariance[:, None] @ inverse)[:, 0]
        # With the new ones: with w = k K^-1 and -1 in the slot, whose row and column are zeros, w w^T is added.
        free = 1.0 + fading * (noise - 1.0) - (known * covariance).sum(axis=1)
        known[rows, slot] = -1.0
        inverse += known[:, :, None] * (known / free[:, None])[:, None, :]
        return inverse

    def predict(self, places: FloatArray, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, dB, of the excess loss at places ``(P, 2)`` of sensors ``(n,)``: ``(P, n)``."""
        shape = (len(places), len(which))
        if self._inverse is None:
            return np.zeros(shape), np.full(shape, self.deviation_db)
        kept = int(self.count.take(which).max(initial=0))
        offset, deviation = self.offset_db, self.deviation_db
        if not kept:
            return np.full(shape, offset), np.full(shape, deviation)
        known_at = self._kept.take(which, 0)[:, :kept]
        east, north = (places[None, :, None, axis] - known_at[:, None, :, axis] for axis in (0, 1))
        # (n, P, kept)
        covariance = self.kind.covariance(np.sqrt(east * east + north * north))
        left = known_at[:, :, _MEASURED] - offset * known_at[:, :, _ONES]
        mean = offset + np.matmul(covariance, left[..., None])[..., 0]
        known = (covariance @ self._inverses(which, kept) * covariance).sum(axis=2)
        # The fading is part of a link's variance, since it differs in the next step.
        share = np.maximum(1.0 - known, self.kind.fading)
        return mean.T, deviation * np.sqrt(share).T

    def _inverses(self, ids: IntArray, kept: int) -> FloatArray:
        """``K^-1`` of these sensors, ``(n, kept, kept)``, with zeros where a sensor has no measurement."""
        assert self._inverse is not None
        return self._inverse.take(ids, 0).take(_packing(kept)[0], 1).reshape(len(ids), kept, kept)

    def _pack(self, ids: IntArray, inverse: FloatArray) -> None:
        """Keep ``K^-1`` of these sensors, ``(n, kept, kept)``."""
        assert self._inverse is not None
        places = _packing(inverse.shape[1])[1]
        self._inverse[ids, : len(places)] = inverse.reshape(len(ids), -1).take(places, 1)

    def _factor(self, ids: IntArray) -> None:
        """Invert the covariances of these sensors' measurements, and estimate what all links have in common."""
        if self._inverse is None:
            most = self._kept.shape[1]
            self._inverse = np.zeros((len(self._kept), most * (most + 1) // 2))
        if size := int(self.count[ids].max(initial=0)):
            used = np.arange(size) < self.count[ids, None]
            apart = _distances(self.places[ids, :size])
            covariances = self.kind.covariances(apart, used, self.noise[ids, :size])
            inverse: FloatArray = np.linalg.inv(covariances).astype(np.float64, copy=False)
            self._pack(ids, inverse * (used[:, :, None] & used[:, None, :]))
            self._kept[ids, :size, _MEASURED:] = _solved(self._inverses(ids, size), self._kept[ids, :size])
        self._estimate()

    def _estimate(self) -> None:
        """The offset and the deviation of all links."""
        excess, measured, ones = (self._kept[..., number] for number in (_EXCESS, _MEASURED, _ONES))
        offset = self.offset_db = float(measured.sum() / (ones.sum() + OFFSET_WEIGHT))
        squares = (excess - offset) * (measured - offset * ones)
        weight = PRIOR_WEIGHT + int(self.count.sum())
        self.deviation_db = float(np.sqrt((PRIOR_WEIGHT * PRIOR_DB**2 + max(float(squares.sum()), 0.0)) / weight))

    def _compare(self) -> None:
        """Choose the kind of shadowing with the highest marginal likelihood, the variance at its estimate."""
        every = np.flatnonzero(self.count)
        kept = int(self.count.max())
        used = np.arange(kept) < self.count[every, None]
        excess, noise = self.excess[every, :kept] * used, self.noise[every, :kept]
        self.kind = KINDS[int(np.argmax(likelihoods(_distances(self.places[every, :kept]), used, excess, noise)))]
        self._factor(every)

    def state_dict(self) -> dict[str, Any]:
        """The measurements and what was solved of them, as copies."""
        arrays = {name: getattr(self, name).copy() for name in ("places", "excess", "noise", "count")}
        measured, ones = self._kept[..., _MEASURED].copy(), self._kept[..., _ONES].copy()
        return {
            **arrays,
            "taken": self._kept[..., _TAKEN].astype(np.int64),
            "heard": self.heard,
            "kind": KINDS.index(self.kind),
            "compared": self._compared,
            "exact": self.exact,
            "solved": None if self._inverse is None else [self._inverse.copy(), measured, ones],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a map, to the bit. One of an earlier version is without what was solved."""
        numbers: list[tuple[slice | int, str]] = [
            (_PLACE, "places"),
            (_EXCESS, "excess"),
            (_NOISE, "noise"),
            (_TAKEN, "taken"),
        ]
        self._kept = np.zeros((*state["excess"].shape, _NUMBERS))
        for number, name in numbers:
            self._kept[..., number] = state[name]
        self.count = state["count"]
        self.heard, self.kind, self._compared = state["heard"], KINDS[state["kind"]], state["compared"]
        self.exact = state["exact"]
        if state.get("solved") is not None:
            self._inverse, self._kept[..., _MEASURED], self._kept[..., _ONES] = state["solved"]
            self._estimate()
        elif not self.exact:
            self._factor(np.arange(len(self.count)))
        elif self.heard:
            self.deviation_db = 0.0


def _solved(inverse: FloatArray, kept: FloatArray) -> FloatArray:
    """``K^-1 r`` and ``K^-1 1``, ``(n, size, 2)``, of sensors' measurements ``(n, size, 7)``."""
    both = np.ones((*kept.shape[:2], 2))
    both[..., 0] = kept[:, :, _EXCESS]
    return np.asarray(inverse @ both)


def _slots(
    kept: FloatArray, count: IntArray, apart: FloatArray, most: int, heard: int
) -> tuple[IntArray, NDArray[np.bool_]]:
    """The slot of each sensor that takes a new measurement, and whether it drops another for it.

    Two measurements of the same place are kept. A third drops the oldest, so that no wrong one stays. A full record
    without any of the place drops the nearest one, which tells the most of what the new one tells.

    Args:
        kept: shape ``(n, size, 7)``, the sensors' measurements.
        count: shape ``(n,)``, how many of them there are.
        apart: shape ``(n, size)``, their squared distances from the new ones, square metres.
        most: measurements that a full record has.
        heard: measurements so far, of all sensors.
    """
    apart = np.where(np.arange(kept.shape[1]) < count[:, None], apart, np.inf)
    same = apart <= _SAME_PLACE_M**2
    full = count == most
    repeated = same.sum(axis=1) >= np.where(full, 1, _MOST_OF_PLACE)
    oldest = np.where(same, kept[:, :, _TAKEN], heard).argmin(axis=1)
    return np.where(repeated, oldest, np.where(full, apart.argmin(axis=1), count)), repeated | full


def _distances(places: FloatArray) -> FloatArray:
    """Distances between the places of each sensor's measurements, ``(n, kept, 2)``: ``(n, kept, kept)``, metres."""
    east, north = (places[:, :, None, axis] - places[:, None, :, axis] for axis in (0, 1))
    return np.asarray(np.sqrt(east * east + north * north))
