"""Maximum channel gain."""

from __future__ import annotations

from shared.world.scenario import Scenario
from simulator.policies.reach import best_in_reach, cruise_velocity
from simulator.world.observation import Observation


class MaximumGain:
    """Collect from the sensor in reach with the highest channel gain.

    The gain depends only on the distance, so this is the sensor closest to the UAV, whatever its queue and its visits.
    With no free sensor in radio range, the choice is the one heard longest ago. The velocity is 7 m/s throughout.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._velocity = cruise_velocity(scenario)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        return best_in_reach(observation["channel_gain"], observation, taken), self._velocity
