"""The radio map: the excess of each sensor's path loss over the formula, learned from the gains of its beacons."""

from __future__ import annotations

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


# A packed symmetric matrix has its upper triangle column by column, in half the memory, so that a leading block of it
# comes first. By row and column, the place in it.
_ROWS, _COLUMNS = np.tril_indices(_MOST_OF_ONE)[::-1]
_PLACE_IN_PACKED = np.zeros((_MOST_OF_ONE, _MOST_OF_ONE), dtype=np.int64)
_PLACE_IN_PACKED[_ROWS, _COLUMNS] = _PLACE_IN_PACKED[_COLUMNS, _ROWS] = np.arange(len(_ROWS))


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
        places: shape ``(J, N, 2)``, metres, of the UAVs at the measurements.
        excess: shape ``(J, N)``, dB, measured.
        noise: shape ``(J, N)``, the factor of the fading's variance of each measurement, at least 1.
        count: shape ``(J,)``, measurements kept.
        heard: measurements so far, of all sensors.
        exact: whether every measurement so far agrees with the formula.
        offset_db: ``mu``, dB: the excess that all links share (generalised least squares, shrunk towards 0).
        deviation_db: ``sigma``, dB: the standard deviation of the excess loss of a link that was never measured.
    """

    def __init__(self, sensors: int) -> None:
        kept = int(np.clip(_MOST_KEPT // sensors, 1, _MOST_OF_ONE))
        self.places: FloatArray = np.zeros((sensors, kept, 2))
        self.excess: FloatArray = np.zeros((sensors, kept))
        self.noise: FloatArray = np.ones((sensors, kept))
        self.count: IntArray = np.zeros(sensors, dtype=np.int64)
        # When each measurement was taken: ``heard`` then.
        self._taken: IntArray = np.zeros((sensors, kept), dtype=np.int64)
        self.heard = 0
        self.kind = KINDS[0]
        self._compared = _COMPARE_FIRST
        self.exact = True
        self.offset_db, self.deviation_db = 0.0, PRIOR_DB
        # By sensor, K^-1 packed, K^-1 r and K^-1 1, with zeros where a sensor has no measurement. None until a gain
        # differs from the formula.
        self._inverse: FloatArray | None = None
        self._measured: FloatArray = np.zeros((sensors, kept))
        self._ones: FloatArray = np.zeros((sensors, kept))

    def measured_db(self) -> dict[int, float]:
        """The mean excess loss of each measured sensor, dB, over the measurements kept; empty if all are exact."""
        if self.exact:
            return {}
        used = np.arange(self.excess.shape[1]) < self.count[:, None]
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
        here = np.asarray(place, dtype=np.float64)
        noise: FloatArray | float = 1.0
        if self.exact and np.abs(excess).max() > _EXACT_DB:
            self.exact = False
            self._factor(np.arange(len(self.count)))
        slot, dropped = self._slots(ids, here)
        if not self.exact:
            noise = self._replace(ids, slot, here, excess)
        self._taken[ids, slot] = self.heard
        self.places[ids, slot], self.excess[ids, slot], self.noise[ids, slot] = here, excess, noise
        self.count[ids] += ~dropped
        if self.exact:
            self.deviation_db = 0.0
        elif self.heard >= self._compared:
            self._compared = int(np.ceil(self.heard * _COMPARE_GROWTH))
            self._compare()
        elif self.heard % _REFRESH < len(ids):
            self._factor(ids)
        else:
            self._solve(ids)
        return excess

    def _replace(self, ids: IntArray, slot: IntArray, here: FloatArray, excess: FloatArray) -> FloatArray:
        """Change ``K^-1`` for new measurements at these slots; returns their noise, by the prediction before them."""
        size = max(int(self.count[ids].max()), int(slot.max()) + 1)
        rows, inverse = np.arange(len(ids)), self._inverses(ids, size)
        away = self.places[ids, :size] - here
        covariance = self._covariance(np.sqrt(np.square(away).sum(axis=2)))
        left = self._measured[ids, :size] - self.offset_db * self._ones[ids, :size]
        known = (covariance[:, None] @ inverse)[:, 0]
        share = np.maximum(1.0 - (known * covariance).sum(axis=1), self.kind.fading)
        deviation = np.maximum(self.deviation_db * np.sqrt(share), _HUBER_LEAST_DB)
        off = np.abs(excess - self.offset_db - (covariance * left).sum(axis=1)) / deviation
        noise: FloatArray = np.square(np.maximum(off / _HUBER, 1.0))
        # Without the measurement that leaves the slot, if there is one.
        own = inverse[rows, slot]
        weight = own[rows, slot]
        own /= np.sqrt(np.where(weight > 0, weight, 1.0))[:, None]
        inverse -= own[:, :, None] * own[:, None, :]
        inverse[rows, slot], inverse[rows, :, slot] = 0.0, 0.0
        # With the one that takes it.
        known = (covariance[:, None] @ inverse)[:, 0]
        free = 1.0 + self.kind.fading * (noise - 1.0) - (known * covariance).sum(axis=1)
        inverse += known[:, :, None] * (known / free[:, None])[:, None, :]
        beside = known / -free[:, None]
        inverse[rows, slot], inverse[rows, :, slot] = beside, beside
        inverse[rows, slot, slot] = 1.0 / free
        assert self._inverse is not None
        few = size * (size + 1) // 2
        self._inverse[ids, :few] = inverse[:, _ROWS[:few], _COLUMNS[:few]]
        return noise

    def _slots(self, ids: IntArray, here: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
        """The slot of each sensor that takes a measurement here, and whether it drops another for it.

        Two measurements of the same place are kept. A third drops the oldest, so that no wrong one stays. A full record
        without any of the place drops the nearest one, which tells the most of what the new one tells.
        """
        slot, kept = self.count[ids], self.excess.shape[1]
        used = int(slot.max())
        if not used:
            return slot, np.zeros(len(ids), dtype=np.bool_)
        east, north = (self.places[ids, :used, axis] - here[axis] for axis in (0, 1))
        apart = np.where(np.arange(used) < slot[:, None], east * east + north * north, np.inf)
        same = apart <= _SAME_PLACE_M**2
        full = slot == kept
        repeated = same.sum(axis=1) >= np.where(full, 1, _MOST_OF_PLACE)
        oldest = np.where(same, self._taken[ids, :used], self.heard).argmin(axis=1)
        slot = np.where(repeated, oldest, np.where(full, apart.argmin(axis=1), slot))
        return slot, repeated | full

    def predict(self, places: FloatArray, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, dB, of the excess loss at places ``(P, 2)`` of sensors ``(n,)``: ``(P, n)``."""
        shape = (len(places), len(which))
        if self._inverse is None:
            return np.zeros(shape), np.full(shape, self.deviation_db)
        kept = int(self.count[which].max(initial=0))
        offset, deviation = self.offset_db, self.deviation_db
        if not kept:
            return np.full(shape, offset), np.full(shape, deviation)
        east, north = (places[None, :, None, axis] - self.places[which, None, :kept, axis] for axis in (0, 1))
        # (n, P, kept)
        covariance = self._covariance(np.sqrt(east * east + north * north))
        left = self._measured[which, :kept] - offset * self._ones[which, :kept]
        mean = offset + np.matmul(covariance, left[..., None])[..., 0]
        known = (covariance @ self._inverses(which, kept) * covariance).sum(axis=2)
        # The fading is part of a link's variance, since it differs in the next step.
        share = np.maximum(1.0 - known, self.kind.fading)
        return mean.T, deviation * np.sqrt(share).T

    def _inverses(self, ids: IntArray, kept: int) -> FloatArray:
        """``K^-1`` of these sensors, ``(n, kept, kept)``, with zeros where a sensor has no measurement."""
        assert self._inverse is not None
        return np.asarray(self._inverse[ids][:, _PLACE_IN_PACKED[:kept, :kept]])

    def _factor(self, ids: IntArray) -> None:
        """Invert the covariances of these sensors' measurements, and estimate what all links have in common."""
        if self._inverse is None:
            most = self.excess.shape[1]
            self._inverse = np.zeros((len(self.excess), most * (most + 1) // 2))
        kept = int(self.count[ids].max(initial=0))
        if kept:
            used = np.arange(kept) < self.count[ids, None]
            inverse: FloatArray = np.linalg.inv(self._covariances(ids, kept)).astype(np.float64, copy=False)
            few = kept * (kept + 1) // 2
            both_used = used[:, :, None] & used[:, None, :]
            self._inverse[ids, :few] = (inverse * both_used)[:, _ROWS[:few], _COLUMNS[:few]]
        self._solve(ids)

    def _solve(self, ids: IntArray) -> None:
        """``K^-1 r`` and ``K^-1 1`` of these sensors, and with them the offset and the deviation of all links."""
        kept = int(self.count[ids].max(initial=0))
        if kept:
            both = np.ones((len(ids), kept, 2))
            both[..., 0] = self.excess[ids, :kept]
            solved = self._inverses(ids, kept) @ both
            self._measured[ids, :kept], self._ones[ids, :kept] = solved[..., 0], solved[..., 1]
        offset = self.offset_db = float(self._measured.sum() / (self._ones.sum() + OFFSET_WEIGHT))
        squares = (self.excess - offset) * (self._measured - offset * self._ones)
        weight = PRIOR_WEIGHT + int(self.count.sum())
        self.deviation_db = float(np.sqrt((PRIOR_WEIGHT * PRIOR_DB**2 + max(float(squares.sum()), 0.0)) / weight))

    def _covariance(self, apart_m: FloatArray) -> FloatArray:
        """The covariance of two measurements of one sensor at places this far apart, without the fading."""
        kind = self.kind
        return kind.sensor + kind.place * np.exp(-apart_m / kind.range_m)

    def _covariances(self, ids: IntArray, kept: int) -> FloatArray:
        """``K``, ``(n, kept, kept)``; the rows without a measurement are the identity's."""
        used = np.arange(kept) < self.count[ids, None]
        matrix = self._covariance(self._apart(ids, kept)) * (used[:, :, None] & used[:, None, :])
        diagonal = 1.0 + self.kind.fading * (self.noise[ids, :kept] - 1.0)
        matrix[:, np.arange(kept), np.arange(kept)] = np.where(used, diagonal, 1.0)
        return np.asarray(matrix)

    def _apart(self, ids: IntArray, kept: int) -> FloatArray:
        """Distances between the places of each sensor's measurements, ``(n, kept, kept)``, metres."""
        at = self.places[ids, :kept]
        east, north = (at[:, :, None, axis] - at[:, None, :, axis] for axis in (0, 1))
        return np.asarray(np.sqrt(east * east + north * north))

    def _compare(self) -> None:
        """Choose the kind of shadowing with the highest marginal likelihood, the variance at its estimate."""
        every = np.flatnonzero(self.count)
        kept = int(self.count.max())
        used = np.arange(kept) < self.count[every, None]
        excess, noise = self.excess[every, :kept] * used, self.noise[every, :kept]
        self.kind = KINDS[int(np.argmax(likelihoods(self._apart(every, kept), used, excess, noise)))]
        self._factor(every)

    def state_dict(self) -> dict[str, Any]:
        """The measurements and what was solved of them, as copies."""
        arrays = {name: getattr(self, name).copy() for name in ("places", "excess", "noise", "count")}
        solved = None if self._inverse is None else [self._inverse.copy(), self._measured.copy(), self._ones.copy()]
        return {
            **arrays,
            "taken": self._taken.copy(),
            "heard": self.heard,
            "kind": KINDS.index(self.kind),
            "compared": self._compared,
            "exact": self.exact,
            "solved": solved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a map, to the bit. One of an earlier version is without what was solved."""
        for name in ("places", "excess", "noise", "count"):
            setattr(self, name, state[name])
        self._taken = state["taken"]
        self.heard, self.kind, self._compared = state["heard"], KINDS[state["kind"]], state["compared"]
        self.exact = state["exact"]
        if state.get("solved") is not None:
            self._inverse, self._measured, self._ones = state["solved"]
            self._solve(np.zeros(0, dtype=np.int64))
        elif not self.exact:
            self._factor(np.arange(len(self.count)))
        elif self.heard:
            self.deviation_db = 0.0
