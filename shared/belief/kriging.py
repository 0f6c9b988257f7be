"""Simple kriging on a radio map's arrays, compiled by numba.

Without numba it is plain Python: a measurement takes 2 ms, the comparison of the kinds of shadowing up to 0.4 s.

Symmetric matrices are packed, as :class:`~shared.belief.shadowing.Measurements` has them.
"""

import math

from shared.belief.shadowing import (
    EAST,
    EXCESS,
    MEASURED,
    NOISE,
    NORTH,
    OFFSET_WEIGHT,
    ONES,
    PRIOR_DB,
    PRIOR_WEIGHT,
    TAKEN,
    LinkStatistics,
    Measurements,
)
from shared.kit.compiled import compiled, inlined
from shared.world.channel import FloatArray, IntArray

# A measurement this many standard deviations from its prediction counts less, as in Huber's estimator.
_HUBER = 3.0
_HUBER_LEAST_DB = 1.0
# The radius of one place, metres, and the largest number of measurements of it that are kept.
_SAME_PLACE_M, _MOST_OF_PLACE = 10.0, 2


@compiled
def take_measurements(
    of: Measurements, links: LinkStatistics, ids: IntArray, east: float, north: float, excess: FloatArray
) -> None:
    """Take one UAV's measurements of n sensors at its place, as :meth:`shared.belief.radio_map.RadioMap.measure` does.

    Args:
        ids: shape ``(n,)``, each sensor once.
        excess: shape ``(n,)``, dB.
    """
    for number in range(ids.shape[0]):
        sensor = ids[number]
        kept, many = of.kept[sensor], of.counts[sensor]
        slot, dropped = _slot(kept, many, east, north, links.heard)
        noise = 1.0
        if of.inverse.shape[0] > 0:
            noise = _replace(kept, many, of.inverse[sensor], of.work, links, east, north, excess[number], slot, dropped)
        kept[slot, EAST], kept[slot, NORTH], kept[slot, EXCESS] = east, north, excess[number]
        kept[slot, NOISE], kept[slot, TAKEN] = noise, links.heard
        if not dropped:
            many += 1
            of.counts[sensor] = many
        if of.inverse.shape[0] > 0:
            _solve(of.inverse[sensor], kept, many, of.work)


@inlined
def _slot(kept: FloatArray, many: int, east: float, north: float, heard: int) -> tuple[int, bool]:
    """The slot that takes a sensor's new measurement, and whether another is dropped for it.

    Two measurements of the same place are kept. A third replaces the oldest, so that a wrong one does not stay. A full
    record without any of the place drops the nearest one, whose information is closest to the new one's.
    """
    same, oldest, nearest = 0, 0, 0
    first, least = float(heard), math.inf
    for n in range(many):
        apart = (kept[n, EAST] - east) ** 2 + (kept[n, NORTH] - north) ** 2
        if apart < least:
            nearest, least = n, apart
        if apart <= _SAME_PLACE_M**2:
            same += 1
            if kept[n, TAKEN] < first:
                oldest, first = n, kept[n, TAKEN]
    full = many == kept.shape[0]
    if same >= (1 if full else _MOST_OF_PLACE):
        return oldest, True
    return (nearest, True) if full else (many, False)


@inlined
def _replace(
    kept: FloatArray,
    many: int,
    inverse: FloatArray,
    work: FloatArray,
    links: LinkStatistics,
    east: float,
    north: float,
    excess: float,
    slot: int,
    dropped: bool,
) -> float:
    """Put a new measurement into a sensor's ``K^-1``; returns its noise, set by the prediction before it."""
    covariance, known, own = work[0], work[1], work[2]
    mean = links.offset_db
    for n in range(many):
        covariance[n] = _covariance(kept, n, east, north, links)
        mean += covariance[n] * (kept[n, MEASURED] - links.offset_db * kept[n, ONES])
    _product(inverse, covariance, many, known)
    share = max(1.0 - _dot(known, covariance, many), links.fading)
    deviation = max(links.deviation_db * math.sqrt(share), _HUBER_LEAST_DB)
    noise = max(abs(excess - mean) / deviation / _HUBER, 1.0) ** 2
    if dropped:
        # The inverse without the measurement that leaves its slot is less by own own^T.
        weight = inverse[_at(slot, slot)]
        root = math.sqrt(weight) if weight > 0.0 else 1.0
        for n in range(many):
            own[n] = inverse[_at(n, slot)] / root
        _add_outer(inverse, own, many, -1.0)
        explained = _dot(own, covariance, many)
        for n in range(many):
            known[n] -= own[n] * explained
            inverse[_at(n, slot)] = 0.0
        # The slot's entry is not exactly 0 otherwise.
        known[slot] = 0.0
    _border(inverse, known, many, slot, 1.0 + links.fading * (noise - 1.0) - _dot(known, covariance, many))
    return noise


@inlined
def _border(inverse: FloatArray, known: FloatArray, many: int, slot: int, free: float) -> None:
    """Add a measurement to ``K^-1`` in a slot whose row and column are zeros.

    With ``w = k K^-1`` and -1 in the slot, and the variance that the others leave free, that is ``w w^T / free``.
    """
    known[slot] = -1.0
    _add_outer(inverse, known, max(many, slot + 1), 1.0 / free)


@compiled
def invert(of: Measurements, links: LinkStatistics, ids: IntArray) -> None:
    """Compute ``K^-1``, ``K^-1 r`` and ``K^-1 1`` of sensors ``(n,)`` anew from their measurements."""
    covariance, known = of.work[0], of.work[1]
    for number in range(ids.shape[0]):
        sensor = ids[number]
        kept, many, inverse = of.kept[sensor], of.counts[sensor], of.inverse[sensor]
        for n in range(inverse.shape[0]):
            inverse[n] = 0.0
        for slot in range(many):
            for n in range(slot):
                covariance[n] = _covariance(kept, n, kept[slot, EAST], kept[slot, NORTH], links)
            _product(inverse, covariance, slot, known)
            free = 1.0 + links.fading * (kept[slot, NOISE] - 1.0) - _dot(known, covariance, slot)
            _border(inverse, known, slot, slot, free)
        _solve(inverse, kept, many, of.work)


@inlined
def _covariance(kept: FloatArray, n: int, east: float, north: float, links: LinkStatistics) -> float:
    """The covariance of a measurement with a place, without the fading."""
    apart = math.sqrt((kept[n, EAST] - east) ** 2 + (kept[n, NORTH] - north) ** 2)
    return links.sensor + links.place * math.exp(-apart / links.range_m)


@compiled
def predict(
    of: Measurements,
    links: LinkStatistics,
    which: IntArray,
    places: FloatArray,
    work: FloatArray,
    mean: FloatArray,
    deviation: FloatArray,
) -> None:
    """Predict the excess losses of sensors ``(n,)`` at places: :meth:`shared.belief.radio_map.RadioMap.predict`.

    The innermost loops are over the places, whose numbers the processor computes several at a time.

    Args:
        places: shape ``(2, P)``, metres.
        work: shape ``(N + 3, P)``, any numbers.
        mean, deviation: the predictions are written here, ``(P, n)``, dB.
    """
    most = of.kept.shape[1]
    # Of the sums over entries of K^-1, those of one row.
    means, explained, row = work[most], work[most + 1], work[most + 2]
    for number in range(which.shape[0]):
        sensor = which[number]
        kept = of.kept[sensor]
        for p in range(places.shape[1]):
            means[p], explained[p] = links.offset_db, 0.0
        for n in range(of.counts[sensor] if of.inverse.shape[0] > 0 else 0):
            covariance, start, inverse = work[n], n * (n + 1) // 2, of.inverse[sensor]
            left = kept[n, MEASURED] - links.offset_db * kept[n, ONES]
            for p in range(places.shape[1]):
                covariance[p] = _covariance(kept, n, places[0, p], places[1, p], links)
            for p in range(places.shape[1]):
                means[p] += covariance[p] * left
                row[p] = 0.5 * inverse[start + n] * covariance[p]
            for r in range(n):
                for p in range(places.shape[1]):
                    row[p] += inverse[start + r] * work[r, p]
            for p in range(places.shape[1]):
                explained[p] += 2.0 * row[p] * covariance[p]
        for p in range(places.shape[1]):
            mean[p, number] = means[p]
            # The fading is part of a link's variance, since it differs in the next step.
            deviation[p, number] = links.deviation_db * math.sqrt(max(1.0 - explained[p], links.fading))


@inlined
def _solve(inverse: FloatArray, kept: FloatArray, many: int, work: FloatArray) -> None:
    """``K^-1 r`` and ``K^-1 1`` of a sensor's measurements."""
    excess, measured, ones = work[0], work[1], work[2]
    for n in range(many):
        excess[n] = kept[n, EXCESS]
    _product(inverse, excess, many, measured)
    for n in range(many):
        kept[n, MEASURED], excess[n] = measured[n], 1.0
    _product(inverse, excess, many, ones)
    for n in range(many):
        kept[n, ONES] = ones[n]


@inlined
def _at(row: int, column: int) -> int:
    """The place of a symmetric matrix's entry in the packed one."""
    low, high = min(row, column), max(row, column)
    return high * (high + 1) // 2 + low


@inlined
def _product(packed: FloatArray, vector: FloatArray, size: int, into: FloatArray) -> None:
    """``into = M v``, of a packed symmetric matrix's leading block."""
    for column in range(size):
        start, total = column * (column + 1) // 2, 0.0
        for row in range(column):
            into[row] += packed[start + row] * vector[column]
            total += packed[start + row] * vector[row]
        into[column] = total + packed[start + column] * vector[column]


@inlined
def _add_outer(packed: FloatArray, vector: FloatArray, size: int, factor: float) -> None:
    """``M += factor v v^T``, of a packed symmetric matrix's leading block."""
    for column in range(size):
        start, weight = column * (column + 1) // 2, factor * vector[column]
        for row in range(column + 1):
            packed[start + row] += vector[row] * weight


@inlined
def _dot(one: FloatArray, other: FloatArray, size: int) -> float:
    """``a b``."""
    total = 0.0
    for n in range(size):
        total += one[n] * other[n]
    return total


@compiled
def estimated(kept: FloatArray, counts: IntArray) -> tuple[float, float]:
    """``mu`` and ``sigma`` of all links, dB, from the solved measurements; arguments as of :class:`Measurements`.

    The offset is shrunk towards 0, and the variance towards its prior.
    """
    measured, ones, squares, number = 0.0, 0.0, 0.0, 0
    for sensor in range(kept.shape[0]):
        number += counts[sensor]
        for n in range(counts[sensor]):
            measured += kept[sensor, n, MEASURED]
            ones += kept[sensor, n, ONES]
    offset = measured / (ones + OFFSET_WEIGHT)
    for sensor in range(kept.shape[0]):
        for n in range(counts[sensor]):
            off = kept[sensor, n, EXCESS] - offset
            squares += off * (kept[sensor, n, MEASURED] - offset * kept[sensor, n, ONES])
    return offset, math.sqrt((PRIOR_WEIGHT * PRIOR_DB**2 + max(squares, 0.0)) / (PRIOR_WEIGHT + number))
