"""The learned schemes MADQN and MAPPO as policies of their trained networks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from shared.world.scenario import Scenario
from simulator.world.observation import Observation

# Torch takes seconds to import.
if TYPE_CHECKING:
    from torch import nn


class Learned:
    """The greedy policy of a network trained by `python -m lab train`; it draws no random number.

    Its input is :func:`lab.marl.network_inputs.actor_input` of the UAV's observation. It chooses among the free
    sensors heard at least once, or among all free sensors if there is none. ``madqn_paper`` has each UAV's plain state,
    and chooses among all sensors.

    Args:
        scheme: ``madqn``, ``mappo`` or ``madqn_paper``.
        checkpoint: weights of that scheme; by default those that ship with the package.

    Raises:
        ValueError: the file has no such weights; at ``reset``, they are for other numbers of sensors, UAVs or
            velocities than the scenario's.
        OSError: the file cannot be read.
    """

    def __init__(self, scheme: str, checkpoint: Path | None = None) -> None:
        from lab.marl.checkpoint import PolicyCheckpoint, shipped

        self._checkpoint = shipped(scheme) if checkpoint is None else PolicyCheckpoint.load(checkpoint)
        self._network: nn.Module

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._network = self._checkpoint.network(scenario)
        self._scenario = scenario

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        from lab.marl.evaluate import chosen
        from lab.marl.network_inputs import taken_mask

        known = taken_mask(taken, self._scenario.sensors)
        sensor, velocity = chosen(self._scenario, self._network, uav, observation, known).tolist()
        return int(sensor), int(velocity)


def madqn() -> Learned:
    """MADQN with the weights that ship: ``--policy lab.marl.learned:madqn``."""
    return Learned("madqn")


def mappo() -> Learned:
    """MAPPO with the weights that ship: ``--policy lab.marl.learned:mappo``."""
    return Learned("mappo")


def madqn_paper() -> Learned:
    """The paper's MADQN with the weights that ship: ``--policy lab.marl.learned:madqn_paper``."""
    return Learned("madqn_paper")
