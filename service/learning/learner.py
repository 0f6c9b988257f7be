"""Online value regression: both modules learn the realised cost of what was decided, one Adam step a feedback.

A mission keeps only numbers, its weights and Adam's moments: an edge flies thousands, and torch's modules take more
memory than what they compute with.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.learning.adam import Moments, stepped
from service.learning.attention import AttentionWeights
from service.learning.backpropagation import descend
from service.learning.parameters import Weights, _buffers
from service.learning.sample import Sample


class Learner:
    """Adam over one mission's weights.

    ``update`` belongs to the event loop; ``score`` and ``velocities`` may be called from any thread: they compute with
    a finished copy, replaced whole after each update, so a decision never sees half a step. Until the first update the
    copy is every mission's that began with it.
    """

    def __init__(self, weights: Weights, *, learning_rate: float) -> None:
        self._layout = weights.layout
        self._learning_rate = learning_rate
        self._moments: Moments | None = None
        self._weights = weights
        self.updates = 0
        self.last_loss: float | None = None

    @property
    def attention(self) -> AttentionWeights:
        """The attention module's weights, as decisions use them now."""
        return self._weights.attention

    def score(self, features: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of n sensors' features ``(n, d)``."""
        return self._weights.score(features)

    def velocities(self, z: Tensor, approach: NDArray[np.float32]) -> Tensor:
        """Values ``(levels,)`` of the velocities for one sensor, from its context ``(d',)``."""
        return self._weights.velocities(z, approach)

    def update(self, sample: Sample, cost: float) -> float:
        """One step on one outcome; returns the loss before it.

        Raises:
            FloatingPointError: the gradient is not finite; nothing is learned, where weights would be lost for good.
        """
        before = self._weights.flat
        gradient, into = _buffers.of(self._layout)
        gradient.zero_()
        loss = descend(self._layout.arrays(before), sample, -cost, into=into)
        if not np.isfinite(gradient.numpy()).all():
            raise FloatingPointError("the gradient of a lesson is not finite")
        self._moments = self._moments or Moments.none(len(before))
        self._weights = Weights(self._layout, stepped(before, self._moments, gradient, self._learning_rate))
        # Who sees that it was learned sees the loss too.
        self.last_loss = loss
        self.updates += 1
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's moments as arrays."""
        views = self._layout.views
        adam: dict[int, dict[str, NDArray[np.float32]]] = {}
        if (kept := self._moments) is not None:
            for index, (mean, square) in enumerate(zip(views(kept.mean), views(kept.square), strict=True)):
                step = np.array(kept.steps, dtype=np.float32)
                adam[index] = {"step": step, "exp_avg": mean.numpy().copy(), "exp_avg_sq": square.numpy().copy()}
        weights = zip(self._layout.names, views(self._weights.flat), strict=True)
        return {
            "weights": {name: tensor.numpy().copy() for name, tensor in weights},
            "adam": adam,
            "updates": self.updates,
            "last_loss": self.last_loss,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken; raises ``RuntimeError`` where that is of other modules."""

        def flat(arrays: Iterable[NDArray[np.float32]]) -> Tensor:
            return self._layout.flat([torch.from_numpy(array) for array in arrays])

        self._weights = Weights(self._layout, flat(state["weights"].values()))
        kept = [state["adam"][index] for index in sorted(state["adam"])]
        self._moments = None
        if kept:
            mean, square = flat(k["exp_avg"] for k in kept), flat(k["exp_avg_sq"] for k in kept)
            self._moments = Moments(mean, square, int(kept[0]["step"]))
        self.updates, self.last_loss = state["updates"], state["last_loss"]
