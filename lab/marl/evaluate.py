"""Evaluation of a network by greedy missions over a batch of worlds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from lab.marl.network_inputs import actor_input, mask_without, uav_slice
from lab.marl.networks import IndependentAgents, greedy, plain_state
from lab.marl.training_worlds import TrainingWorlds
from shared.world.channel import IntArray
from shared.world.scenario import Scenario
from simulator.world.batch import BatchStep


def lost_packets(scenario: Scenario, network: nn.Module, seeds: Sequence[int]) -> IntArray:
    """Packets that a greedy fleet loses in each world, ``(B,)``; equal to those of ``rollout`` with the trained policy.

    UAV 0 decides first, and no UAV takes a sensor that an earlier one took.
    """
    lost = np.zeros(len(seeds), dtype=np.int64)
    for _, outcome in flown_greedily(scenario, network, seeds):
        lost += outcome.lost_packets
    return lost


def flown_greedily(
    scenario: Scenario, network: nn.Module, seeds: Sequence[int]
) -> Iterator[tuple[IntArray, BatchStep]]:
    """Each step of a greedy fleet in B worlds: the sensors chosen ``(B, I)``, and the outcome."""
    world = TrainingWorlds(scenario)
    observation = world.reset(seeds)
    rows = np.arange(len(seeds))
    for _ in range(scenario.steps):
        taken = np.zeros((len(seeds), scenario.sensors), dtype=np.bool_)
        actions = np.zeros((len(seeds), scenario.uavs, 2), dtype=np.int64)
        for uav in range(scenario.uavs):
            actions[:, uav] = chosen(scenario, network, uav, uav_slice(observation, uav), taken)
            taken[rows, actions[:, uav, 0]] = True
        observation, outcome = world.step(actions[..., 0], actions[..., 1])
        yield actions[..., 0], outcome


def chosen(
    scenario: Scenario, network: nn.Module, uav: int, observation: Mapping[str, Any], taken: NDArray[np.bool_]
) -> IntArray:
    """A UAV's greedy sensor and velocity, ``(..., 2)``; leading dimensions are those of the observation.

    Args:
        taken: by sensor, ``(..., J)``, the choices of earlier UAVs; independent agents do not know them.
    """
    if isinstance(network, IndependentAgents):
        return np.asarray(network.greedy(uav, plain_state(scenario, observation)).numpy())
    own = actor_input(scenario, uav, observation)
    best = greedy(network, scenario.sensors, own.features, mask_without(own, taken))
    best[..., 0] = np.take_along_axis(own.order, best[..., :1], axis=-1)[..., 0]
    return best
