"""Online value regression: both modules learn the realised cost of what was decided, one Adam step a feedback."""

from __future__ import annotations

import copy
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from service.adam import Adam, lay_side_by_side
from service.attention import Attention
from service.features import FEATURES
from service.reach import LEVEL_FEATURES
from service.velocity import ReachVelocityScorer, VelocityScorer
from shared.wire import Features


@dataclass(frozen=True, slots=True)
class Sample:
    """One decision as the modules saw it.

    ``features`` are the admissible sensors' ``(n, d)``, ``chosen`` the row that was decided for, ``approach``
    what the velocity scorer was told of that sensor (see :meth:`State.approach`), ``velocity`` the level flown.
    """

    features: NDArray[np.float32]
    chosen: int
    approach: NDArray[np.float32]
    velocity: int


class Modules(nn.Module):
    """The attention and velocity modules of one feature preset, which learn jointly."""

    def __init__(self, preset: Features, levels: int, seed: int) -> None:
        super().__init__()
        self.preset: Features = preset
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.attention = Attention(FEATURES[preset])
            self.velocity = VelocityScorer(levels) if preset == "paper" else ReachVelocityScorer(LEVEL_FEATURES)

    def evaluate(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` of the sensors, and values ``(levels,)`` of the velocities for the sensor decided."""
        scores, z = self.attention(torch.from_numpy(sample.features))
        return scores, self.velocity(z[sample.chosen], torch.from_numpy(sample.approach).to(z.dtype))

    def loss(self, sample: Sample, reward: float) -> Tensor:
        """``(s_j - r)^2 + (u_v - r)^2`` for the sensor j and velocity v decided, r = -c."""
        scores, values = self.evaluate(sample)
        loss: Tensor = (scores[sample.chosen] - reward) ** 2 + (values[sample.velocity] - reward) ** 2
        return loss

    @torch.inference_mode()
    def score(self, features: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')``, without gradients."""
        scores, z = self.attention(torch.from_numpy(features))
        return scores, z

    @torch.inference_mode()
    def velocities(self, z: Tensor, approach: NDArray[np.float32]) -> Tensor:
        """Values ``(levels,)`` of the velocities for one sensor, without gradients."""
        values: Tensor = self.velocity(z, torch.from_numpy(approach))
        return values


class Learner:
    """Adam over one mission's modules.

    ``update`` belongs to the learning thread; ``score`` and ``velocities`` may be called from any: they compute with
    a copy that is renewed after each update, so a decision never sees half a step and hardly waits for one.
    """

    def __init__(self, modules: Modules, *, learning_rate: float) -> None:
        self._training = modules
        self._parameters = list(modules.parameters())
        self._adam = Adam(self._parameters, learning_rate=learning_rate)
        self._current = copy.deepcopy(modules).requires_grad_(False)
        self._shown = lay_side_by_side(list(self._current.parameters()))
        self._computing = threading.Lock()
        self.updates = 0
        self.last_loss: float | None = None

    def score(self, features: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` and contexts ``(n, d')`` of n sensors' features ``(n, d)``."""
        with self._computing:
            return self._current.score(features)

    def velocities(self, z: Tensor, approach: NDArray[np.float32]) -> Tensor:
        """Values ``(levels,)`` of the velocities for one sensor, from its context ``(d',)``."""
        with self._computing:
            return self._current.velocities(z, approach)

    def update(self, sample: Sample, cost: float) -> float:
        """One step on one outcome; returns the loss before it."""
        loss = self._training.loss(sample, -cost)
        self._adam.step(torch.autograd.grad(loss, self._parameters))
        self._show()
        # Who sees that it was learned sees the loss too.
        self.last_loss = loss.item()
        self.updates += 1
        return self.last_loss

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's moments as arrays; from the learning thread, or where there is none."""
        return {
            "weights": {name: tensor.numpy().copy() for name, tensor in self._training.state_dict().items()},
            "adam": self._adam.state_dict(),
            "updates": self.updates,
            "last_loss": self.last_loss,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken; raises ``RuntimeError`` where that is of other modules."""
        self._training.load_state_dict({name: torch.from_numpy(array) for name, array in state["weights"].items()})
        self._adam.load_state_dict(state["adam"])
        self._show()
        self.updates, self.last_loss = state["updates"], state["last_loss"]

    def _show(self) -> None:
        with self._computing:
            self._shown.copy_(self._adam.weights)


def rehearse() -> None:
    """Update once on nothing: torch's first step back takes longer than the others."""
    features = np.zeros((2, FEATURES["paper"]), np.float32)
    learner = Learner(Modules("paper", 1, seed=0), learning_rate=1e-3)
    learner.update(Sample(features, 0, np.zeros(1, np.float32), 0), 0.0)
    learner.score(features)
