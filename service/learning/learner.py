"""Online value regression: each outcome trains both modules on its realised cost, by one step of Adam.

A mission stores only numbers, its weights and Adam's moments: an edge serves thousands of missions, and torch modules
take more memory than their parameters. The gradient is written out in numpy: about thirty products of small arrays take
a tenth of the time of torch's autograd.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.learning.modules import Array, Layout, Parameters, Sample, Weights

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8


class Learner:
    """Trains one mission's weights.

    ``update`` belongs to the event loop. Any thread may compute with ``weights``: an update replaces them as a whole,
    so no decision sees half a step. Missions with the same initial weights share them until their first update.

    Attributes:
        weights: the newest weights, which decisions use.
        updates: number of training steps.
        last_loss: loss before the last step, None before the first.
    """

    def __init__(self, weights: Weights, *, learning_rate: float) -> None:
        self._layout = weights.layout
        self._learning_rate = learning_rate
        self._moments: Moments | None = None
        self.weights = weights
        self.updates = 0
        self.last_loss: float | None = None

    def update(self, sample: Sample, cost: float) -> float:
        """Take one step of Adam on one outcome; returns the loss before it.

        Raises:
            FloatingPointError: the gradient is not finite. The weights, which would be lost for good, do not change.
        """
        weights = self.weights
        gradient, into = _gradient_of(weights.layout)
        gradient.fill(0)
        loss = descend(weights.parameters, sample, -cost, into=into)
        if not np.isfinite(gradient).all():
            raise FloatingPointError("the gradient of a training sample is not finite")
        if self._moments is None:
            self._moments = Moments(np.zeros_like(gradient), np.zeros_like(gradient))
        self.weights = Weights(weights.layout, adam_step(weights.flat, self._moments, gradient, self._learning_rate))
        # The loss comes first: a reader that sees the new count also sees the new loss.
        self.last_loss = loss
        self.updates += 1
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's moments as arrays."""
        arrays = self._layout.arrays
        adam: dict[int, dict[str, Array]] = {}
        if (moments := self._moments) is not None:
            step = np.array(moments.steps, dtype=np.float32)
            both = zip(arrays(moments.mean), arrays(moments.square), strict=True)
            for index, (mean, square) in enumerate(both):
                adam[index] = {"step": step, "exp_avg": mean.copy(), "exp_avg_sq": square.copy()}
        return {
            "weights": {n: p.copy() for n, p in zip(self._layout.names, self.weights.parameters, strict=True)},
            "adam": adam,
            "updates": self.updates,
            "last_loss": self.last_loss,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state; raises ``ValueError`` where it belongs to modules of another preset or other levels."""
        flat = self._layout.flat
        self.weights = Weights(self._layout, flat(list(state["weights"].values())))
        adam = [state["adam"][index] for index in sorted(state["adam"])]
        self._moments = None
        if adam:
            mean, square = flat([one["exp_avg"] for one in adam]), flat([one["exp_avg_sq"] for one in adam])
            self._moments = Moments(mean, square, int(adam[0]["step"]))
        self.updates, self.last_loss = state["updates"], state["last_loss"]


@dataclass(slots=True)
class Moments:
    """Adam's running means of the gradient and of its square, ``(n,)`` each, after some steps."""

    mean: Array
    square: Array
    steps: int = 0


def adam_step(weights: Array, moments: Moments, gradient: Array, learning_rate: float) -> Array:
    """The weights ``(n,)`` after one more step of Adam (Kingma and Ba 2015) down the gradient ``(n,)``.

    The result equals that of ``torch.optim.Adam`` but for the last bits. That class imports torch's compiler at its
    first use, during which nothing else of the process runs for seconds, and takes its steps parameter by parameter.
    This function changes the moments, and overwrites the gradient.
    """
    moments.steps += 1
    mean, square = moments.mean, moments.square
    work = gradient - mean
    work *= np.float32(1 - _BETA1)
    mean += work
    gradient *= gradient
    gradient *= np.float32(1 - _BETA2)
    square *= np.float32(_BETA2)
    square += gradient
    np.sqrt(square, out=gradient)
    gradient /= np.float32((1 - _BETA2**moments.steps) ** 0.5)
    gradient += np.float32(_EPS)
    np.divide(mean, gradient, out=work)
    work *= np.float32(learning_rate / (1 - _BETA1**moments.steps))
    return weights - work


# A BLAS kernel may raise the flag although its input is finite; the caller checks the gradient.
@np.errstate(invalid="ignore")
def descend(weights: Parameters, sample: Sample, reward: float, into: Parameters) -> float:
    """The loss ``(s_j - r)^2 + (u_v - r)^2`` of :meth:`Modules.loss`, and its gradient.

    Of all sensors' scores the loss reads one, that of the chosen sensor. So the work grows with the number of sensors,
    whereas the backward pass of the whole attention grows with its square.

    Args:
        into: the gradient is written here; zeros before.
    """
    x, own = sample.features, sample.features[sample.chosen]
    scale = np.float32(len(weights.query) ** -0.5)
    # Forward, the chosen sensor's row: s = w z + b with z = W_v sum_i p_i x_i, p = softmax(q K^T / sqrt(d')).
    q = weights.query @ own
    p = x @ (scale * (q @ weights.key))
    p -= p.max()
    np.exp(p, out=p)
    p /= p.sum()
    attended = p @ x
    z = weights.value @ attended
    # Preset `paper` has one approach for all levels and an output for each level; preset `reach` the other way round.
    shared_approach = sample.approach.ndim == 1
    row, approach = (sample.velocity, sample.approach) if shared_approach else (0, sample.approach[sample.velocity])
    velocity_input = np.concatenate((z, approach))
    h = np.maximum(weights.hidden @ velocity_input + weights.hidden_bias, 0)
    off_score = weights.score[0] @ z + weights.bias[0] - np.float32(reward)
    off_value = weights.out[row] @ h + weights.out_bias[row] - np.float32(reward)
    # Backward.
    ds, du = 2 * off_score, 2 * off_value
    into.score[0], into.bias[0] = ds * z, ds
    into.out[row], into.out_bias[row] = du * h, du
    dh = np.where(h > 0, du * weights.out[row], np.float32(0))
    # np.outer takes several times as long for a few numbers.
    np.multiply(dh[:, None], velocity_input, out=into.hidden)
    into.hidden_bias[:] = dh
    dz = ds * weights.score[0] + (dh @ weights.hidden)[: len(z)]
    np.multiply(dz[:, None], attended, out=into.value)
    dp = x @ (dz @ weights.value)
    da = p * (dp - p @ dp)
    mixed = scale * (da @ x)
    np.multiply((weights.key @ mixed)[:, None], own, out=into.query)
    np.multiply(q[:, None], mixed, out=into.key)
    return float(off_score * off_score + off_value * off_value)


def _gradient_of(layout: Layout) -> tuple[Array, Parameters]:
    """This thread's flat gradient of the layout's size, and its views by parameter.

    A new one for each training sample would fragment the heap.
    """
    buffers: dict[tuple[str, int], tuple[Array, Parameters]] = _gradients.__dict__.setdefault("by_layout", {})
    kind = layout.preset, layout.size
    if kind not in buffers:
        gradient = np.zeros(layout.size, dtype=np.float32)
        buffers[kind] = gradient, layout.arrays(gradient)
    return buffers[kind]


_gradients = threading.local()
