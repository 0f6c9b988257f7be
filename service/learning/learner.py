"""Online value regression: each outcome trains both modules on its realised cost, by one step of Adam.

A mission stores only numbers, its weights and Adam's moments: an edge serves thousands of missions, and torch modules
take more memory than their parameters. The gradient is written out in numpy: about thirty products of small arrays take
a tenth of the time of torch's autograd.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

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
        before = self.weights.flat
        gradient, into = _gradient_of(self._layout)
        gradient.zero_()
        loss = descend(self._layout.arrays(before), sample, -cost, into=into)
        if not np.isfinite(gradient.numpy()).all():
            raise FloatingPointError("the gradient of a training sample is not finite")
        if self._moments is None:
            self._moments = Moments(torch.zeros(len(before)), torch.zeros(len(before)))
        self.weights = Weights(self._layout, adam_step(before, self._moments, gradient, self._learning_rate))
        # The loss comes first: a reader that sees the new count also sees the new loss.
        self.last_loss = loss
        self.updates += 1
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's moments as arrays."""
        views = self._layout.views
        adam: dict[int, dict[str, Array]] = {}
        if (moments := self._moments) is not None:
            for index, (mean, square) in enumerate(zip(views(moments.mean), views(moments.square), strict=True)):
                step = np.array(moments.steps, dtype=np.float32)
                adam[index] = {"step": step, "exp_avg": mean.numpy().copy(), "exp_avg_sq": square.numpy().copy()}
        weights = zip(self._layout.names, views(self.weights.flat), strict=True)
        return {
            "weights": {name: tensor.numpy().copy() for name, tensor in weights},
            "adam": adam,
            "updates": self.updates,
            "last_loss": self.last_loss,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state; raises ``RuntimeError`` where it belongs to modules of another preset or other levels."""

        def flat(arrays: Iterable[Array]) -> Tensor:
            return self._layout.flat([torch.from_numpy(array) for array in arrays])

        self.weights = Weights(self._layout, flat(state["weights"].values()))
        adam = [state["adam"][index] for index in sorted(state["adam"])]
        self._moments = None
        if adam:
            mean, square = flat(one["exp_avg"] for one in adam), flat(one["exp_avg_sq"] for one in adam)
            self._moments = Moments(mean, square, int(adam[0]["step"]))
        self.updates, self.last_loss = state["updates"], state["last_loss"]


@dataclass(slots=True)
class Moments:
    """Adam's running means of the gradient and of its square, ``(n,)`` each, after some steps."""

    mean: Tensor
    square: Tensor
    steps: int = 0


@torch.no_grad()
def adam_step(weights: Tensor, moments: Moments, gradient: Tensor, learning_rate: float) -> Tensor:
    """The weights ``(n,)`` after one more step of Adam (Kingma and Ba 2015) down the gradient ``(n,)``.

    The result equals that of ``torch.optim.Adam`` to the bit. That class imports torch's compiler at its first use,
    during which nothing else of the process runs for seconds, and takes its steps parameter by parameter. This function
    changes the moments, and overwrites the gradient.
    """
    moments.steps += 1
    mean, square = moments.mean, moments.square
    mean.lerp_(gradient, 1 - _BETA1)
    square.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
    spread = torch.sqrt(square, out=gradient).div_((1 - _BETA2**moments.steps) ** 0.5).add_(_EPS)
    return torch.addcdiv(weights, mean, spread, value=-learning_rate / (1 - _BETA1**moments.steps))


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
    np.outer(dh, velocity_input, out=into.hidden)
    into.hidden_bias[:] = dh
    dz = ds * weights.score[0] + (dh @ weights.hidden)[: len(z)]
    np.outer(dz, attended, out=into.value)
    dp = x @ (dz @ weights.value)
    da = p * (dp - p @ dp)
    mixed = scale * (da @ x)
    np.outer(weights.key @ mixed, own, out=into.query)
    np.outer(q, mixed, out=into.key)
    return float(off_score * off_score + off_value * off_value)


def _gradient_of(layout: Layout) -> tuple[Tensor, Parameters]:
    """This thread's flat gradient for a layout, and its views by parameter.

    A new one for each training sample would fragment the heap.
    """
    buffers: dict[Layout, tuple[Tensor, Parameters]] = _gradients.__dict__.setdefault("by_layout", {})
    if layout not in buffers:
        gradient = torch.zeros(layout.size)
        buffers[layout] = gradient, layout.arrays(gradient)
    return buffers[layout]


_gradients = threading.local()
