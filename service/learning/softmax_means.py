"""Means of many values, weighted by the softmax of products, compiled by numba: one head of attention over sensors.

``mean_i = sum_j w_ij v_j / sum_j w_ij`` with ``w_ij = exp(q_i k_j)``, without an array of all pairs.
"""

import math

import numpy as np
from numpy.typing import NDArray

from shared.kit.compiled import compiled_fused, inlined_fused

Array = NDArray[np.float32]

# Queries per block, so that their data stays in a core's first-level cache.
_SHARE = 256
# Places of rows of a share's numbers.
_1, _2, _3, _LARGEST, _ZEROS = (row * _SHARE for row in range(1, 6))
# Keys multiplied with a query at a time, and dimensions added at a time.
_KEYS, _DIMENSIONS = 4, 4
# A query's largest product is estimated from about this many keys. If the sum of the weights then exceeds the limit,
# all keys are searched.
_SOME_KEYS, _MOST_WEIGHT = 64, np.float32(2.0**100)
# Exponents of 2. Weights below the least are practically zero, yet above the slow denormal numbers; weights above the
# largest overflow.
_LEAST, _MOST = np.float32(-100.0), np.float32(126.0)
# Added to an exponent and subtracted, it rounds it; the sum's last bits are the whole number, a fraction has 23.
_ROUNDS, _FRACTION_BITS = np.float32(1.5 * 2**23), np.int32(23)
# 2^f = sum_n c_n f^n for -1/2 <= f <= 1/2, fitted to the least maximum relative error: 2.3e-7 with rounding.
_C0, _C1, _C2 = np.float32(1.0000001192), np.float32(0.693146944), np.float32(0.2402212024)
_C3, _C4, _C5 = np.float32(0.0555071309), np.float32(0.0096755410), np.float32(0.0013276471)


def softmax(logits: Array) -> Array:
    """The softmax of each row ``(m, n)``; the logits are overwritten."""
    # For a few numbers the array methods take twice as long.
    logits -= np.maximum.reduce(logits, axis=1, keepdims=True)
    np.exp(logits, out=logits)
    logits /= np.add.reduce(logits, axis=1, keepdims=True)
    return logits


def softmax_means(queries: Array, keys: Array, values: Array) -> Array:
    """The weighted means ``(m,)``.

    Args:
        queries: shape ``(m, d)``.
        keys: shape ``(n, d)``, at least one.
        values: shape ``(n,)``.
    """
    # Dimensions are padded with zeros, and keys with the first key at weight 0.
    n, d = keys.shape
    rows, columns = -(-n // _KEYS) * _KEYS, -(-d // _DIMENSIONS) * _DIMENSIONS
    filled = np.zeros((rows, columns), dtype=np.float32)
    filled[:n, :d], filled[n:, :d] = keys, keys[0]
    counted = np.zeros((rows, 2), dtype=np.float32)
    counted[:n, 0], counted[:n, 1] = 1.0, values
    # Powers of 2 are faster to compute than powers of e.
    shares = -(-len(queries) // _SHARE)
    wide = np.zeros((shares * _SHARE, columns), dtype=np.float32)
    wide[: len(queries), :d] = queries * np.float32(math.log2(math.e))
    means = [_means(share.T.ravel(), filled, counted) for share in wide.reshape(shares, _SHARE, columns)]
    return np.concatenate(means)[: len(queries)]


def _means(queries: Array, keys: Array, counted: Array) -> Array:
    """The means of one share's queries, ``(d m,)`` by dimension."""
    work, sums = np.empty(6 * _SHARE, dtype=np.float32), np.empty((2, _SHARE), dtype=np.float32)
    _sum_up(queries, keys, counted, _KEYS * max(1, len(keys) // _SOME_KEYS), work, sums)
    if not (sums[0] < _MOST_WEIGHT).all():
        _sum_up(queries, keys, counted, _KEYS, work, sums)
    return np.asarray(sums[1] / sums[0])


@compiled_fused
def _sum_up(queries: Array, keys: Array, counted: Array, stride: int, work: Array, sums: Array) -> None:
    """Write the sums of the weights and of the weighted values, ``(2, m)``.

    ``work`` gets the products of four keys, the largest product, which is searched in four keys of each ``stride`` and
    has weight 1, and zeros.
    """
    weight, weighted = sums[0], sums[1]
    last = keys.shape[1] - _DIMENSIONS
    for i in range(_SHARE):
        work[_LARGEST + i], work[_ZEROS + i], weight[i], weighted[i] = -math.inf, 0.0, 0.0, 0.0
    for j in range(0, keys.shape[0], stride):
        for c in range(0, keys.shape[1], _DIMENSIONS):
            _multiply(queries[c * _SHARE :], keys, j, c, work, _ZEROS)
        for i in range(_SHARE):
            of_two, of_others = max(work[i], work[_1 + i]), max(work[_2 + i], work[_3 + i])
            work[_LARGEST + i] = max(work[_LARGEST + i], max(of_two, of_others))
    for j in range(0, keys.shape[0], _KEYS):
        for c in range(0, last, _DIMENSIONS):
            _multiply(queries[c * _SHARE :], keys, j, c, work, _LARGEST)
        _multiply(queries[last * _SHARE :], keys, j, last, work, _LARGEST)
        _add(work, counted, j, weight, weighted)


@inlined_fused
def _multiply(queries: Array, keys: Array, j: int, c: int, work: Array, less: int) -> None:
    """Add the products of four keys with the queries in four dimensions; the first ones less a row of ``work``.

    Four keys share the reads of the queries. Rows are at fixed places of one array, so that the compiler knows that
    they do not overlap, and uses vector instructions.
    """
    a0, a1, a2, a3 = keys[j, c], keys[j, c + 1], keys[j, c + 2], keys[j, c + 3]
    b0, b1, b2, b3 = keys[j + 1, c], keys[j + 1, c + 1], keys[j + 1, c + 2], keys[j + 1, c + 3]
    c0, c1, c2, c3 = keys[j + 2, c], keys[j + 2, c + 1], keys[j + 2, c + 2], keys[j + 2, c + 3]
    d0, d1, d2, d3 = keys[j + 3, c], keys[j + 3, c + 1], keys[j + 3, c + 2], keys[j + 3, c + 3]
    if c == 0:
        for i in range(_SHARE):
            q0, q1, q2, q3, own = queries[i], queries[_1 + i], queries[_2 + i], queries[_3 + i], work[less + i]
            work[i] = a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3 - own
            work[_1 + i] = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3 - own
            work[_2 + i] = c0 * q0 + c1 * q1 + c2 * q2 + c3 * q3 - own
            work[_3 + i] = d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3 - own
    else:
        for i in range(_SHARE):
            q0, q1, q2, q3 = queries[i], queries[_1 + i], queries[_2 + i], queries[_3 + i]
            work[i] += a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3
            work[_1 + i] += b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3
            work[_2 + i] += c0 * q0 + c1 * q1 + c2 * q2 + c3 * q3
            work[_3 + i] += d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3


@inlined_fused
def _add(work: Array, counted: Array, j: int, weight: Array, weighted: Array) -> None:
    """Add four keys' weights, and their values with these weights."""
    a0, a1, a2, a3 = counted[j, 0], counted[j + 1, 0], counted[j + 2, 0], counted[j + 3, 0]
    b0, b1, b2, b3 = counted[j, 1], counted[j + 1, 1], counted[j + 2, 1], counted[j + 3, 1]
    for i in range(_SHARE):
        w0, w1, w2, w3 = _two_to(work[i]), _two_to(work[_1 + i]), _two_to(work[_2 + i]), _two_to(work[_3 + i])
        weight[i] += (w0 * a0 + w1 * a1) + (w2 * a2 + w3 * a3)
        weighted[i] += (w0 * b0 + w1 * b1) + (w2 * b2 + w3 * b3)


@inlined_fused
def _two_to(exponent: np.float32) -> np.float32:
    """2 to an exponent: of the rest after rounding, with the whole number added to the bits of its exponent."""
    limited = min(max(exponent, _LEAST), _MOST)
    shifted = np.float32(limited + _ROUNDS)
    f = limited - (shifted - _ROUNDS)
    part = np.float32(((((_C5 * f + _C4) * f + _C3) * f + _C2) * f + _C1) * f + _C0)
    return np.int32(part.view(np.int32) + (shifted.view(np.int32) << _FRACTION_BITS)).view(np.float32)
