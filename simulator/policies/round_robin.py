"""Round robin."""

from __future__ import annotations

import numpy as np

from shared.world.scenario import Scenario
from simulator.policies.reach import cruise_velocity, free_sensors
from simulator.world.observation import Observation


class RoundRobin:
    """Every UAV cycles through the sensors, in range or not; UAV i starts at sensor ``i J / I``.

    Sensors taken by other UAVs are skipped. The velocity is 7 m/s throughout.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._uavs = scenario.uavs
        self._velocity = cruise_velocity(scenario)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        count = len(observation["queue"])
        position = uav * count // self._uavs + int(observation["step"][0])
        free = np.roll(free_sensors(count, taken), -(position % count))
        return (position + int(np.argmax(free))) % count, self._velocity
