"""The networks of the learned schemes: the paper's trunk, and two heads for the actors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lab.marl.network_inputs import width
from shared.world.scenario import Scenario

TRUNK = (400, 300)
# The logit or action value of a masked choice: below any other, and finite, so that the softmax is defined.
NEVER = -1e9


def trunk(inputs: int, outputs: int) -> nn.Sequential:
    """Fully connected layers of widths 400 and 300 with ReLU, and a linear output layer."""
    first, second = TRUNK
    return nn.Sequential(
        nn.Linear(inputs, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, outputs)
    )


def two_heads(scenario: Scenario) -> nn.Sequential:
    """A network from one UAV's features ``(..., F)`` to a number for each sensor slot and velocity, ``(..., J + V)``.

    Both heads share one trunk, so the last layer is their concatenation.
    """
    return trunk(width(scenario), scenario.sensors + scenario.max_velocity + 1)


def greedy(
    network: nn.Module, sensors: int, features: NDArray[np.float32], mask: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The best allowed slot and velocity of each head, ``(..., 2)``, of features ``(..., F)`` and masks."""
    with torch.no_grad():
        values: Tensor = network(torch.from_numpy(features))
    values = torch.where(torch.from_numpy(mask), values, NEVER)
    best = torch.stack((values[..., :sensors].argmax(-1), values[..., sensors:].argmax(-1)), dim=-1)
    return np.asarray(best.numpy())
