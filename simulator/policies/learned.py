"""The learned schemes MADQN and MAPPO as policies of their trained networks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.world.observation import Observation

# Torch takes seconds to import, and is not installed without the extra `service`.
if TYPE_CHECKING:
    from torch import nn


class Learned:
    """The greedy policy of a network trained by `python -m lab train`; it draws no random number.

    Its input is :func:`simulator.policies.network_inputs.view` of the UAV's observation. It chooses among the free
    sensors heard at least once, or among all free sensors if there is none.

    Args:
        scheme: ``madqn`` or ``mappo``.
        checkpoint: weights of that scheme; by default those that ship with the package.

    Raises:
        UsageError: torch is not installed.
        ValueError: the file has no such weights; at ``reset``, they are for other numbers of sensors, UAVs or
            velocities than the scenario's.
        OSError: the file cannot be read.
    """

    def __init__(self, scheme: str, checkpoint: Path | None = None) -> None:
        try:
            from simulator.policies.checkpoint import Checkpoint, shipped
        except ModuleNotFoundError as missing:
            raise UsageError(
                f"policy {scheme} needs {missing.name}, which is not installed. "
                "Install the extra: pip install 'aic-vds[service]'"
            ) from None
        self._checkpoint = shipped(scheme) if checkpoint is None else Checkpoint.load(checkpoint)
        self._network: nn.Module

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._network = self._checkpoint.network(scenario)
        self._scenario = scenario

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        from simulator.policies.network_inputs import taken_by, view, without
        from simulator.policies.networks import greedy

        own = view(self._scenario, uav, observation)
        mask = without(own, taken_by(taken, self._scenario.sensors))
        slot, velocity = greedy(self._network, self._scenario.sensors, own.features, mask).tolist()
        return int(own.order[slot]), velocity
