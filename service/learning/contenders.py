"""The sensors that may have the highest scores, found without all scores: attention over very many sensors.

A score is ``F(q) = sum_j w_j v_j`` with ``w = softmax(q k_j)``. From a centre ``q`` to ``q + d``, with the products
``a_j = d k_j`` and the ranges r of ``a`` and s of ``v``,

    F(q + d) = F(q) + Cov(a, v) + R,    |R| <= min(sqrt(3) / 16 r^2 s, r s / 4 + |Cov(a, v)|)

where the covariance has the weights ``w`` of the centre. Taylor's remainder is half the second derivative, the third
moment of ``a``, ``a`` and ``v`` somewhere on the way: at most the product of the deviations of ``(a - mean)^2``, by
Bhatia and Davis (2000) ``sqrt(3) / 4 r^2``, and of ``v``, by Popoviciu (1935) ``s / 2``. The other bound is Gruess's
(1935), of a covariance on the way.
"""

from __future__ import annotations

import math

import numpy as np

from service.learning.softmax_means import Array, softmax
from shared.world.channel import IntArray

# Centres are the means of so many groups of queries: by one dimension, and in each of these by another.
_GROUPS, _PARTS = 32, 4
# What rounding may add to a bound, as a share of the values' range.
_ROUNDING = 1e-4


def contenders(queries: Array, keys: Array, values: Array, best: int, added: Array | None = None) -> IntArray:
    """The queries that may have one of the ``best`` highest means, ascending: all of these are among them.

    Args:
        queries: shape ``(m, d)``, more than ``best``.
        keys: shape ``(n, d)``.
        values: shape ``(n,)``.
        added: shape ``(m,)``, counts beside the means.
    """
    ranges, spread = np.ptp(keys, axis=0), np.ptp(values)
    groups = _groups(queries, ranges)
    away = queries[groups]
    centres = away.mean(axis=1)
    away -= centres[:, None]
    weights = softmax(centres @ keys.T)
    means = weights @ values
    covariances = (weights * values) @ keys - means[:, None] * (weights @ keys)
    more = np.matmul(away, covariances[:, :, None])[:, :, 0]
    widest = np.abs(away, out=away) @ ranges
    error = np.minimum(math.sqrt(3) / 16 * widest**2 * spread, widest * spread / 4 + np.abs(more))
    likely, unsure = np.empty((2, len(queries)), dtype=np.float32)
    likely[groups], unsure[groups] = means[:, None] + more, error
    if added is not None:
        likely += added
    surely = np.partition(likely - unsure, -best)[-best]
    # Nothing is ruled out where a number is not finite.
    return np.flatnonzero(~(likely + unsure < surely - _ROUNDING * spread))


def _groups(queries: Array, ranges: Array) -> IntArray:
    """Groups of near queries, equally large, ``(groups, members)``; the last ones are filled up with others."""
    one, two = np.argsort(-queries.std(axis=0) * ranges)[:2]
    members = -(-len(queries) // (_GROUPS * _PARTS))
    ordered = np.resize(np.argsort(queries[:, one]), _GROUPS * _PARTS * members).reshape(_GROUPS, -1)
    inner = np.argsort(queries[ordered, two], axis=1)
    return np.take_along_axis(ordered, inner, axis=1).reshape(_GROUPS * _PARTS, members)
