"""Earliest overflow first."""

from __future__ import annotations

from shared.world.scenario import Scenario
from simulator.policies.reach import best_in_reach, cruise_velocity
from simulator.world.observation import Observation


class EarliestOverflowFirst:
    """Collect from the sensor in reach with the fewest expected steps to overflow, ``(W - q_j) / rate``.

    The rate is the scenario's mean arrival rate for every sensor, since beacons do not report it. With no free sensor
    in radio range, the choice is the one heard longest ago. The velocity is 7 m/s throughout.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._capacity = scenario.queue_capacity
        self._rate = max(scenario.mean_arrival_rate, 1e-9)
        self._velocity = cruise_velocity(scenario)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        steps_left = (self._capacity - observation["queue"]) / self._rate
        return best_in_reach(-steps_left, observation, taken), self._velocity
