"""One step of online value regression: its gradient, written out, and Adam, compiled by numba.

The step has about thirty products of small arrays; each takes longer to call than to compute, so one function has all.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.learning.modules import Parameters, Sample
from service.learning.softmax_means import Array
from shared.kit.compiled import compiled, inlined

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8


@dataclass(slots=True)
class Moments:
    """Adam's running means of the gradient and of its square, ``(n,)`` each, after some steps."""

    mean: Array
    square: Array
    steps: int = 0


def adam_step(weights: Array, moments: Moments, gradient: Array, learning_rate: float) -> Array:
    """The weights ``(n,)`` after one more step of Adam (Kingma and Ba 2015) down the gradient ``(n,)``.

    The result equals that of ``torch.optim.Adam`` but for the last bits. This function changes the moments.

    Raises:
        FloatingPointError: the gradient is not finite; the moments do not change.
    """
    steps, after = moments.steps + 1, np.empty_like(weights)
    rate, root = np.float32(learning_rate / (1 - _BETA1**steps)), np.float32((1 - _BETA2**steps) ** 0.5)
    if not _adam(weights, moments.mean, moments.square, gradient, rate, root, after):
        raise FloatingPointError("the gradient of a training sample is not finite")
    moments.steps = steps
    return after


def descend(weights: Parameters, sample: Sample, reward: float, into: Parameters) -> float:
    """The loss ``(s_j - r)^2 + (u_v - r)^2`` and its gradient.

    The loss depends on the chosen sensor's score only. So the work grows with the number of sensors, whereas the
    backward pass of the whole attention grows with its square.

    Args:
        into: the gradient is written here; zeros before.
    """
    x, approach = sample.features, sample.approach
    # Preset `paper` has one approach for all levels and an output for each level; preset `reach` the other way round.
    shared_approach = approach.ndim == 1
    row, own = (sample.velocity, approach) if shared_approach else (0, approach[sample.velocity])
    by_sensor = np.empty((2, len(x)), dtype=np.float32)
    by_width = np.empty((7, weights.hidden.shape[1]), dtype=np.float32)
    return _descend(weights, x, sample.chosen, own, row, np.float32(reward), into, by_sensor, by_width)


@compiled
def _descend(
    weights: Parameters,
    x: Array,
    chosen: int,
    approach: Array,
    row: int,
    reward: np.float32,
    into: Parameters,
    by_sensor: Array,
    by_width: Array,
) -> float:
    """As :func:`descend`; ``by_sensor`` ``(2, n)`` and ``by_width`` ``(7, d' + a)`` may have any numbers."""
    width = weights.query.shape[0]
    scale = np.float32(1.0 / math.sqrt(width))
    p, dp = by_sensor[0], by_sensor[1]
    q, wide, attended, h = by_width[0], by_width[1], by_width[2], by_width[3]
    dh, mixed, dz = by_width[4], by_width[5], by_width[6]
    # Forward, the chosen sensor's row: s = w z + b with z = W_v sum_i p_i x_i, p = softmax(q K^T / sqrt(d')).
    _product(weights.query, x[chosen], q)
    _transposed_product(weights.key, q, scale, mixed)
    _softmax(x, mixed, p)
    _transposed_product(x, p, np.float32(1.0), attended)
    # The velocity module's input is z and the approach.
    _product(weights.value, attended, wide)
    for i in range(approach.shape[0]):
        wide[width + i] = approach[i]
    off_score, off_value = weights.bias[0] - reward, weights.out_bias[row] - reward
    for i in range(width):
        h[i] = weights.hidden_bias[i]
        for j in range(wide.shape[0]):
            h[i] += weights.hidden[i, j] * wide[j]
        off_score += weights.score[0, i] * wide[i]
        off_value += weights.out[row, i] * max(h[i], np.float32(0.0))
    # Backward.
    ds, du = np.float32(2.0) * off_score, np.float32(2.0) * off_value
    into.bias[0], into.out_bias[row] = ds, du
    for i in range(width):
        into.score[0, i] = ds * wide[i]
        into.out[row, i] = du * max(h[i], np.float32(0.0))
        dh[i] = du * weights.out[row, i] if h[i] > 0 else np.float32(0.0)
        into.hidden_bias[i] = dh[i]
    _outer(dh, wide, into.hidden)
    _transposed_product(weights.hidden, dh, np.float32(1.0), dz)
    for i in range(width):
        dz[i] += ds * weights.score[0, i]
    _outer(dz, attended, into.value)
    _transposed_product(weights.value, dz, np.float32(1.0), mixed)
    _softmax_gradient(x, mixed, p, dp)
    _transposed_product(x, dp, scale, mixed)
    _outer(q, mixed, into.key)
    _product(weights.key, mixed, h)
    _outer(h, x[chosen], into.query)
    return float(off_score * off_score + off_value * off_value)


@inlined
def _product(matrix: Array, vector: Array, into: Array) -> None:
    """``into = M v``."""
    for i in range(matrix.shape[0]):
        into[i] = np.float32(0.0)
        for j in range(matrix.shape[1]):
            into[i] += matrix[i, j] * vector[j]


@inlined
def _transposed_product(matrix: Array, vector: Array, factor: np.float32, into: Array) -> None:
    """``into = factor M^T v``."""
    for j in range(matrix.shape[1]):
        into[j] = np.float32(0.0)
    for i in range(matrix.shape[0]):
        weight = factor * vector[i]
        for j in range(matrix.shape[1]):
            into[j] += matrix[i, j] * weight


@inlined
def _outer(one: Array, other: Array, into: Array) -> None:
    """``into = a b^T``."""
    for i in range(into.shape[0]):
        for j in range(into.shape[1]):
            into[i, j] = one[i] * other[j]


@inlined
def _softmax(x: Array, query: Array, p: Array) -> None:
    """``p = softmax(x q)``."""
    _product(x, query, p)
    most, total = p[0], np.float32(0.0)
    for i in range(p.shape[0]):
        most = max(most, p[i])
    for i in range(p.shape[0]):
        p[i] = math.exp(p[i] - most)
        total += p[i]
    for i in range(p.shape[0]):
        p[i] /= total


@inlined
def _softmax_gradient(x: Array, query: Array, p: Array, dp: Array) -> None:
    """``dp = p (x q - p (x q))``, the gradient of the products before the softmax."""
    _product(x, query, dp)
    mean = np.float32(0.0)
    for i in range(p.shape[0]):
        mean += p[i] * dp[i]
    for i in range(p.shape[0]):
        dp[i] = p[i] * (dp[i] - mean)


@compiled
def _adam(
    weights: Array, mean: Array, square: Array, gradient: Array, rate: np.float32, root: np.float32, after: Array
) -> bool:
    """As :func:`adam_step`, with the correction of the mean in ``rate``, and the root of that of the square.

    Returns whether the gradient is finite; otherwise nothing changes.
    """
    for i in range(gradient.shape[0]):
        if not math.isfinite(gradient[i]):
            return False
    keep, take = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
    fade, least = np.float32(_BETA2), np.float32(_EPS)
    for i in range(weights.shape[0]):
        mean[i] += keep * (gradient[i] - mean[i])
        square[i] = fade * square[i] + take * (gradient[i] * gradient[i])
        after[i] = weights[i] - rate * (mean[i] / (math.sqrt(square[i]) / root + least))
    return True
