"""Weighted queue-channel scheduling."""

from __future__ import annotations

import numpy as np

from shared.world.channel import path_loss_db
from shared.world.scenario import Scenario
from simulator.policies.reach import best_in_reach, cruise_velocity
from simulator.world.observation import Observation


class WeightedQueueChannel:
    """Collect from the sensor in reach with the highest ``0.5 q_j / W + 0.5 h_j``.

    ``h_j`` is the channel gain scaled to 0 at the path-loss threshold and 1 right below the UAV. With no free sensor in
    radio range, the choice is the one heard longest ago. The velocity is 7 m/s throughout.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._capacity = scenario.queue_capacity
        self._limit = scenario.path_loss_limit_db
        self._span = max(self._limit - float(path_loss_db(0.0, scenario)), 1e-9)
        self._velocity = cruise_velocity(scenario)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        channel = np.clip((observation["channel_gain"] + self._limit) / self._span, 0.0, 1.0)
        score = 0.5 * observation["queue"] / self._capacity + 0.5 * channel
        return best_in_reach(score, observation, taken), self._velocity
