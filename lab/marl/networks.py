"""The networks of the learned schemes: the paper's trunk, and two heads for the actors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lab.marl.network_inputs import width
from shared.world.scenario import Scenario

TRUNK = (400, 300)
# The scheme whose UAVs have a network each.
INDEPENDENT = "madqn_paper"
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


def plain_width(scenario: Scenario) -> int:
    """The length of :func:`plain_state`."""
    return 2 + 3 * scenario.sensors


def plain_state(scenario: Scenario, observation: Mapping[str, Any]) -> Tensor:
    """The paper's plain state: a UAV's position, and the queues, batteries and channel gains that it last heard.

    Shares of the area's side, W, the full battery and the threshold; 0 for a sensor never heard. Leading dimensions are
    those of the observation.
    """
    heard = np.asarray(observation["last_heard"]) >= 0
    columns = (
        np.asarray(observation["position"]) / scenario.area_m,
        np.where(heard, np.asarray(observation["queue"]) / scenario.queue_capacity, 0.0),
        np.where(heard, np.asarray(observation["battery"]) / scenario.battery_j, 0.0),
        np.where(heard, 1.0 + np.asarray(observation["channel_gain"]) / scenario.path_loss_limit_db, 0.0),
    )
    return torch.from_numpy(np.concatenate(columns, axis=-1).astype(np.float32))


class IndependentAgents(nn.Module):
    """A network for each UAV on its plain state, with a head of J sensors and one of V velocities."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self._heads = [scenario.sensors, scenario.max_velocity + 1]
        self.agents = nn.ModuleList(trunk(plain_width(scenario), sum(self._heads)) for _ in range(scenario.uavs))

    def forward(self, uav: int, state: Tensor) -> tuple[Tensor, ...]:
        """The values of the sensors ``(..., J)`` and of the velocities ``(..., V)``."""
        values: tuple[Tensor, ...] = self.agents[uav](state).split(self._heads, -1)
        return values

    def greedy(self, uav: int, state: Tensor) -> Tensor:
        """The best sensor and velocity, ``(..., 2)``."""
        with torch.no_grad():
            return torch.stack([head.argmax(-1) for head in self(uav, state)], dim=-1)


def network_of(scheme: str, scenario: Scenario) -> nn.Module:
    """The network of a scheme's actors, with random weights."""
    return IndependentAgents(scenario) if scheme == INDEPENDENT else two_heads(scenario)
