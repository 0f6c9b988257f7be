"""Online value regression: each outcome trains both modules on its realised cost, by one step of Adam.

A mission stores only numbers, its weights and Adam's moments: an edge serves thousands of missions, and torch modules
take more memory than their parameters.
"""

import threading
from typing import Any

import numpy as np

from service.learning.modules import Layout, Parameters, Sample, Weights
from service.learning.softmax_means import Array
from service.learning.training_step import Moments, adam_step, descend


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
            FloatingPointError: the gradient is not finite; the weights do not change.
        """
        weights = self.weights
        gradient, into = _gradient_of(weights.layout)
        gradient.fill(0)
        loss = descend(weights.parameters, sample, -cost, into=into)
        if self._moments is None:
            self._moments = Moments(np.zeros_like(gradient), np.zeros_like(gradient))
        self.weights = Weights(weights.layout, adam_step(weights.flat, self._moments, gradient, self._learning_rate))
        # The loss is set first, so that a reader of the new count also sees the new loss.
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
        """Restore a state; raises ``ValueError`` if it belongs to modules of another preset or other levels."""
        flat = self._layout.flat
        self.weights = Weights(self._layout, flat(list(state["weights"].values())))
        adam = [state["adam"][index] for index in sorted(state["adam"])]
        self._moments = None
        if adam:
            mean, square = flat([one["exp_avg"] for one in adam]), flat([one["exp_avg_sq"] for one in adam])
            self._moments = Moments(mean, square, int(adam[0]["step"]))
        self.updates, self.last_loss = state["updates"], state["last_loss"]


def _gradient_of(layout: Layout) -> tuple[Array, Parameters]:
    """This thread's flat gradient of the layout's size, and its views by parameter.

    Allocating one for each training sample would fragment the heap.
    """
    buffers: dict[tuple[str, int], tuple[Array, Parameters]] = _gradients.__dict__.setdefault("by_layout", {})
    kind = layout.preset, layout.size
    if kind not in buffers:
        gradient = np.zeros(layout.size, dtype=np.float32)
        buffers[kind] = gradient, layout.arrays(gradient)
    return buffers[kind]


_gradients = threading.local()
