"""The random policy."""

from __future__ import annotations

import numpy as np

from shared.world.scenario import Scenario
from simulator.policies.reach import free_sensors
from simulator.world.observation import Observation


class RandomChoice:
    """A sensor uniform over those not taken, heard or not, and a velocity uniform over all levels.

    Its generator shares no stream with the world of the same seed.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission with a generator of that seed."""
        self._rng = np.random.default_rng(np.random.SeedSequence((seed, int.from_bytes(b"random"))))
        self._levels = scenario.max_velocity + 1

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        free = np.flatnonzero(free_sensors(len(observation["queue"]), taken))
        return int(self._rng.choice(free)), int(self._rng.integers(self._levels))
