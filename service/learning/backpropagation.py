"""The gradient of one lesson's loss, written out.

Of all sensors' scores the loss reads one: the attention's row of the sensor decided. So a lesson costs as much as there
are sensors, where going back through the whole attention costs the square; and some thirty products of small arrays
take a tenth of the time that torch's autograd takes for them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from service.learning.sample import Array, Sample


class Parameters(NamedTuple):
    """Both modules' parameters, or their gradients, in the modules' order.

    ``W_q``, ``W_k``, ``W_v`` ``(d', d)``; the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``; the velocity scorer's
    ``W_1`` ``(d', d' + a)``, ``b_1``, ``W_2`` ``(levels or 1, d')`` and ``b_2``.
    """

    query: Array
    key: Array
    value: Array
    score: Array
    bias: Array
    hidden: Array
    hidden_bias: Array
    out: Array
    out_bias: Array


# A BLAS kernel may raise the flag though all it was asked for is finite; whether the gradient is, the caller sees.
@np.errstate(invalid="ignore")
def descend(weights: Parameters, sample: Sample, reward: float, into: Parameters) -> float:
    """The loss ``(s_j - r)^2 + (u_v - r)^2`` of :meth:`Modules.loss`, and its gradient.

    Args:
        into: where the gradient is written; zeros before.
    """
    x, own = sample.features, sample.features[sample.chosen]
    scale = np.float32(len(weights.query) ** -0.5)
    # Forward: the row of the sensor decided, s = w z + b with z = W_v sum_i p_i x_i, p = softmax(q K^T / sqrt(d')).
    q = weights.query @ own
    p = x @ (scale * (q @ weights.key))
    p -= p.max()
    np.exp(p, out=p)
    p /= p.sum()
    heard = p @ x
    z = weights.value @ heard
    # A scorer with one approach for all levels has an output for each; one with an approach a level has one output.
    each = sample.approach.ndim == 1
    row, told = (sample.velocity, sample.approach) if each else (0, sample.approach[sample.velocity])
    told = np.concatenate((z, told))
    h = np.maximum(weights.hidden @ told + weights.hidden_bias, 0)
    off_score = weights.score[0] @ z + weights.bias[0] - np.float32(reward)
    off_value = weights.out[row] @ h + weights.out_bias[row] - np.float32(reward)
    # Back.
    ds, du = 2 * off_score, 2 * off_value
    into.score[0], into.bias[0] = ds * z, ds
    into.out[row], into.out_bias[row] = du * h, du
    dh = np.where(h > 0, du * weights.out[row], np.float32(0))
    np.outer(dh, told, out=into.hidden)
    into.hidden_bias[:] = dh
    dz = ds * weights.score[0] + (dh @ weights.hidden)[: len(z)]
    np.outer(dz, heard, out=into.value)
    dp = x @ (dz @ weights.value)
    da = p * (dp - p @ dp)
    mixed = scale * (da @ x)
    np.outer(weights.key @ mixed, own, out=into.query)
    np.outer(q, mixed, out=into.key)
    return float(off_score * off_score + off_value * off_value)
