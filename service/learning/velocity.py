"""u_phi: a value for every velocity level, given the chosen sensor's context and how the UAV would approach it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.learning.attention import WIDTH


class VelocityWeights(NamedTuple):
    """``W_1``, ``b_1``, ``W_2``, ``b_2``."""

    hidden: Tensor
    hidden_bias: Tensor
    out: Tensor
    out_bias: Tensor


class VelocityScorer(nn.Module):
    """``u = W_2 relu(W_1 [z_j, distance] + b_1) + b_2``, one value a velocity level: the paper's."""

    def __init__(self, levels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + 1, width)
        self.out = nn.Linear(width, levels)

    def forward(self, z: Tensor, distance: Tensor) -> Tensor:
        """As :func:`by_distance`."""
        return by_distance(_weights(self.hidden, self.out), z, distance)


class ReachVelocityScorer(nn.Module):
    """``u_v = w_2 relu(W_1 [z_j, a_v] + b_1) + b_2``: the same weights for every level v, told what it would bring.

    ``a_v`` is a row of :meth:`Reach.level_features`; so a scenario may have any number of levels.
    """

    def __init__(self, level_features: int, width: int = WIDTH) -> None:
        super().__init__()
        self.hidden = nn.Linear(width + level_features, width)
        self.out = nn.Linear(width, 1)

    def forward(self, z: Tensor, levels: Tensor) -> Tensor:
        """As :func:`by_reach`."""
        return by_reach(_weights(self.hidden, self.out), z, levels)


def by_distance(weights: VelocityWeights, z: Tensor, distance: Tensor) -> Tensor:
    """Values ``(..., levels)`` from the context ``(..., d')`` and the normalised distance ``(..., 1)``."""
    return _values(weights, torch.cat([z, distance], dim=-1))


def by_reach(weights: VelocityWeights, z: Tensor, levels: Tensor) -> Tensor:
    """Values ``(..., levels)`` from the context ``(..., d')`` and the levels' features ``(..., levels, 4)``."""
    context = z[..., None, :].expand(*levels.shape[:-1], z.shape[-1])
    return _values(weights, torch.cat([context, levels], dim=-1))[..., 0]


def _values(weights: VelocityWeights, told: Tensor) -> Tensor:
    hidden = torch.relu(functional.linear(told, weights.hidden, weights.hidden_bias))
    return functional.linear(hidden, weights.out, weights.out_bias)


def _weights(hidden: nn.Linear, out: nn.Linear) -> VelocityWeights:
    return VelocityWeights(hidden.weight, hidden.bias, out.weight, out.bias)
