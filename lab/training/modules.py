"""The attention and velocity modules as torch modules, for training offline.

:mod:`service.learning.modules` has the equations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from service.learning.initial_weights import initial_parameters
from service.learning.modules import WIDTH, Sample, Weights
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES
from shared.wire.schemas import Features, Init


class Attention(nn.Module):
    """Scaled dot-product attention over the sensors, one head of width d' = 32, and a linear score.

    ``Q, K, V = X W_q, X W_k, X W_v``; ``Z = softmax(Q K^T / sqrt(d')) V``; ``s = Z w + b``. Callers pass the
    admissible sensors only, or a mask of them: a masked sensor never reaches the softmax. torch's fused kernel makes
    no J x J tensor.
    """

    def __init__(self, features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.query = nn.Linear(features, width, bias=False)
        self.key = nn.Linear(features, width, bias=False)
        self.value = nn.Linear(features, width, bias=False)
        self.score = nn.Linear(width, 1)

    def forward(self, x: Tensor, admissible: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Scores ``(..., n)`` and contexts ``(..., n, d')`` of n sensors' features ``(..., n, d)``.

        Args:
            admissible: ``(..., n)`` booleans; the results of the other sensors are meaningless. Default: all are true.
        """
        # Only for four axes (batch, head, n, d') torch selects the kernel without an n x n tensor.
        n, d = x.shape[-2:]
        wide = x.reshape(-1, 1, n, d)
        mask = None if admissible is None else admissible.reshape(-1, 1, 1, n)
        z = functional.scaled_dot_product_attention(self.query(wide), self.key(wide), self.value(wide), attn_mask=mask)
        z = z.reshape(*x.shape[:-1], -1)
        return self.score(z)[..., 0], z


class VelocityScorer(nn.Module):
    """``u = W_2 relu(W_1 [z_j, distance] + b_1) + b_2``, one value for each level; the paper leaves it open."""

    def __init__(self, levels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + 1, width)
        self.out = nn.Linear(width, levels)

    def forward(self, z: Tensor, distance: Tensor) -> Tensor:
        """Values ``(..., levels)`` from the context ``(..., d')`` and the normalised distance ``(..., 1)``."""
        values: Tensor = self.out(torch.relu(self.hidden(torch.cat([z, distance], dim=-1))))
        return values


class ReachVelocityScorer(nn.Module):
    """``u_v = w_2 relu(W_1 [z_j, a_v] + b_1) + b_2``, with the same weights for every velocity level v.

    ``a_v`` is a row of :meth:`State.approaches`, the effects of flying at v. So a scenario may have any number of
    levels.
    """

    def __init__(self, level_features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + level_features, width)
        self.out = nn.Linear(width, 1)

    def forward(self, z: Tensor, levels: Tensor) -> Tensor:
        """Values ``(..., levels)`` from the context ``(..., d')`` and the levels' features ``(..., levels, 4)``."""
        context = z[..., None, :].expand(*levels.shape[:-1], z.shape[-1])
        values: Tensor = self.out(torch.relu(self.hidden(torch.cat([context, levels], dim=-1))))
        return values[..., 0]


class Modules(nn.Module):
    """The attention and velocity modules of one feature preset, which are trained jointly."""

    def __init__(self, preset: Features, levels: int, seed: int, init: Init = "random") -> None:
        super().__init__()
        self.preset: Features = preset
        # torch's layers draw numbers before they get these parameters; its own generator does not change.
        with torch.random.fork_rng(devices=[]):
            self.attention = Attention(FEATURES[preset])
            self.velocity = VelocityScorer(levels) if preset == "paper" else ReachVelocityScorer(LEVEL_FEATURES)
        own = initial_parameters(init, preset, levels, seed)
        self.load_state_dict({name: torch.tensor(value) for name, value in own.items()})

    def evaluate(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` of the sensors, and values ``(levels,)`` of the velocities for the chosen sensor."""
        scores, z = self.attention(torch.from_numpy(sample.features))
        return scores, self.velocity(z[sample.chosen], torch.from_numpy(sample.approach).to(z.dtype))

    def loss(self, sample: Sample, reward: float) -> Tensor:
        """``(s_j - r)^2 + (u_v - r)^2`` for the chosen sensor j and velocity v, r = -c."""
        scores, values = self.evaluate(sample)
        loss: Tensor = (scores[sample.chosen] - reward) ** 2 + (values[sample.velocity] - reward) ** 2
        return loss

    def weights(self) -> Weights:
        """A copy of the parameters for decisions."""
        return Weights.of(self.preset, {name: p.detach().numpy() for name, p in self.named_parameters()})

    def save(self, path: Path) -> None:
        """Write the weights with the name of their feature preset."""
        weights = {name: value.numpy() for name, value in self.state_dict().items()}
        with path.open("wb") as file:
            np.savez(file, features=np.array(self.preset), **weights)
