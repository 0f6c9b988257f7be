"""Means of many values, weighted by the softmax of products, compiled by numba: one head of attention over sensors.

``mean_i = sum_j w_ij v_j / sum_j w_ij`` with ``w_ij = exp(q_i k_j)``, without an array of all pairs.
"""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from shared.kit.compiled import compiled, inlined

Array = NDArray[np.float32]

# Queries per block, so that their data stays in a core's first-level cache.
_SHARE = 256
# Keys multiplied with a query at a time, and dimensions added at a time.
_KEYS, _DIMENSIONS = 4, 4
# A query's largest product is estimated from about this many keys. If the sum of the weights then exceeds the limit,
# all keys are searched.
_SOME_KEYS, _MOST_WEIGHT = 64, np.float32(2.0**100)
# Exponents of 2. Weights below the least are practically zero, yet above the slow denormal numbers; weights above the
# largest overflow.
_LEAST, _MOST = np.float32(-100.0), np.float32(126.0)
# Added before an exponent is truncated and subtracted afterwards, which rounds it.
_ROUNDS, _BACK = np.float32(126.5), np.float32(126.0)
# The bits of a number's exponent, and the exponent of 1 after _ROUNDS.
_EXPONENT, _ONE = np.int32(23), np.int32(1)
# 2^f = sum_n c_n f^n for -1/2 <= f <= 1/2, fitted to the least maximum relative error: 2.3e-7 with rounding.
_C0, _C1, _C2 = np.float32(1.0000001192), np.float32(0.693146944), np.float32(0.2402212024)
_C3, _C4, _C5 = np.float32(0.0555071309), np.float32(0.0096755410), np.float32(0.0013276471)


class _Work(NamedTuple):
    """A share's numbers for four keys at a time, ``(4, m)`` each, and for all keys, ``(m,)`` each.

    A weight is ``part`` times ``scale``, a power of 2 whose bits ``power`` has. The product ``largest`` has weight 1.
    ``weight`` and ``weighted`` are sums.
    """

    product: Array
    part: Array
    power: NDArray[np.int32]
    scale: Array
    largest: Array
    weight: Array
    weighted: Array

    @classmethod
    def empty(cls, queries: int) -> Self:
        product, part = np.empty((2, _KEYS, queries), dtype=np.float32)
        power = np.empty((_KEYS, queries), dtype=np.int32)
        return cls(product, part, power, power.view(np.float32), *np.empty((3, queries), dtype=np.float32))


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
    wide = np.zeros((columns, len(queries)), dtype=np.float32)
    wide[:d] = queries.T * np.float32(math.log2(math.e))

    def means(first: int) -> Array:
        return _means(np.ascontiguousarray(wide[:, first : first + _SHARE]), filled, counted)

    return np.concatenate([means(first) for first in range(0, len(queries), _SHARE)])


def _means(queries: Array, keys: Array, counted: Array) -> Array:
    """The means of one share's queries ``(d, m)``."""
    work = _Work.empty(queries.shape[1])
    _sum_up(queries, keys, counted, _KEYS * max(1, len(keys) // _SOME_KEYS), work)
    if not (work.weight < _MOST_WEIGHT).all():
        _sum_up(queries, keys, counted, _KEYS, work)
    return work.weighted / work.weight


@compiled
def _sum_up(queries: Array, keys: Array, counted: Array, stride: int, work: _Work) -> None:
    """Write the sums of the weights and of the weighted values.

    The largest product is searched in four keys of each ``stride``.
    """
    largest, product, part = work.largest, work.product, work.part
    for i in range(len(largest)):
        largest[i], work.weight[i], work.weighted[i] = -math.inf, 0.0, 0.0
    for j in range(0, keys.shape[0], stride):
        _multiply(queries, work.weight, keys, j, product[0], product[1], product[2], product[3])
        _raise_largest(product, largest)
    for j in range(0, keys.shape[0], _KEYS):
        _multiply(queries, largest, keys, j, product[0], product[1], product[2], product[3])
        for k in range(_KEYS):
            _raise_two(product[k], part[k], work.power[k])
        _add(part, work.scale, counted, j, work.weight, work.weighted)


@inlined
def _raise_largest(product: Array, largest: Array) -> None:
    for i in range(len(largest)):
        of_two, of_others = max(product[0, i], product[1, i]), max(product[2, i], product[3, i])
        largest[i] = max(largest[i], max(of_two, of_others))


@inlined
def _multiply(
    queries: Array, largest: Array, keys: Array, j: int, into0: Array, into1: Array, into2: Array, into3: Array
) -> None:
    """The products of four keys with the queries, less the largest ones.

    Four keys share the reads of the queries. Their arrays are separate arguments, because indexing them would prevent
    vector instructions.
    """
    for c in range(0, queries.shape[0], _DIMENSIONS):
        a0, a1, a2, a3 = keys[j, c], keys[j, c + 1], keys[j, c + 2], keys[j, c + 3]
        b0, b1, b2, b3 = keys[j + 1, c], keys[j + 1, c + 1], keys[j + 1, c + 2], keys[j + 1, c + 3]
        c0, c1, c2, c3 = keys[j + 2, c], keys[j + 2, c + 1], keys[j + 2, c + 2], keys[j + 2, c + 3]
        d0, d1, d2, d3 = keys[j + 3, c], keys[j + 3, c + 1], keys[j + 3, c + 2], keys[j + 3, c + 3]
        if c == 0:
            for i in range(len(largest)):
                q0, q1, q2, q3, less = queries[0, i], queries[1, i], queries[2, i], queries[3, i], largest[i]
                into0[i] = a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3 - less
                into1[i] = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3 - less
                into2[i] = c0 * q0 + c1 * q1 + c2 * q2 + c3 * q3 - less
                into3[i] = d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3 - less
        else:
            for i in range(len(largest)):
                q0, q1, q2, q3 = queries[c, i], queries[c + 1, i], queries[c + 2, i], queries[c + 3, i]
                into0[i] += a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3
                into1[i] += b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3
                into2[i] += c0 * q0 + c1 * q1 + c2 * q2 + c3 * q3
                into3[i] += d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3


@inlined
def _raise_two(exponent: Array, part: Array, power: NDArray[np.int32]) -> None:
    """Write 2 to each exponent as a number from 0.7 to 1.5 and the bits of a power of 2."""
    for i in range(len(exponent)):
        limited = min(max(exponent[i], _LEAST), _MOST)
        rounded = np.int32(limited + _ROUNDS)
        f = limited - (np.float32(rounded) - _BACK)
        part[i] = ((((_C5 * f + _C4) * f + _C3) * f + _C2) * f + _C1) * f + _C0
        power[i] = (rounded + _ONE) << _EXPONENT


@inlined
def _add(part: Array, scale: Array, counted: Array, j: int, weight: Array, weighted: Array) -> None:
    """Add four keys' weights, and their values with these weights."""
    a0, a1, a2, a3 = counted[j, 0], counted[j + 1, 0], counted[j + 2, 0], counted[j + 3, 0]
    b0, b1, b2, b3 = counted[j, 1], counted[j + 1, 1], counted[j + 2, 1], counted[j + 3, 1]
    for i in range(len(weight)):
        w0, w1 = part[0, i] * scale[0, i], part[1, i] * scale[1, i]
        w2, w3 = part[2, i] * scale[2, i], part[3, i] * scale[3, i]
        weight[i] += (w0 * a0 + w1 * a1) + (w2 * a2 + w3 * a3)
        weighted[i] += (w0 * b0 + w1 * b1) + (w2 * b2 + w3 * b3)
