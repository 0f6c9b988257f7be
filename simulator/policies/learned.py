"""The learned schemes, MADQN and MAPPO, flown by their trained networks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from shared.scenario import Scenario
from simulator.errors import UsageError
from simulator.world import Observation

# Torch takes seconds to import, and whoever flies another policy may not have it.
if TYPE_CHECKING:
    from torch import nn


class Learned:
    """The best sensor and velocity by a network that `aicvds train` trained; draws nothing.

    It sees what :func:`simulator.marl.observation.view` makes of the UAV's observation, and chooses among the sensors
    heard at least once that no one took in this step. If there is none, among those not taken.

    Args:
        scheme: ``madqn`` or ``mappo``.
        checkpoint: weights of that scheme; the ones that ship with the package where none is named.

    Raises:
        UsageError: torch is not installed.
        ValueError: the file holds no such weights; at ``reset``, they are for other numbers of sensors, UAVs or
            velocities than the scenario's.
        OSError: it cannot be read.
    """

    def __init__(self, scheme: str, checkpoint: Path | None = None) -> None:
        try:
            from simulator.marl.checkpoint import Checkpoint, shipped
        except ModuleNotFoundError as missing:
            raise UsageError(
                f"policy {scheme} needs {missing.name}, which is not installed. "
                "Install the extra: pip install 'aic-vds[marl]'"
            ) from None
        self._checkpoint = shipped(scheme) if checkpoint is None else Checkpoint.load(checkpoint)
        self._network: nn.Module

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._network = self._checkpoint.network(scenario)
        self._scenario = scenario

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        from simulator.marl.networks import greedy
        from simulator.marl.observation import taken_by, view, without

        own = view(self._scenario, uav, observation)
        mask = without(own, taken_by(taken, self._scenario.sensors))
        slot, velocity = greedy(self._network, self._scenario.sensors, own.features, mask).tolist()
        return int(own.order[slot]), velocity
