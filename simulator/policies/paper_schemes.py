"""EOF and WQCS of the paper; docs/reference/method.md has our readings where its text is open.

The velocity follows the distance to the chosen sensor, by the velocity strategy of the paper's prompt. Its UAVs choose
independently; a coordinated scheme also leaves out the sensors that earlier UAVs of the step chose.
"""

from abc import ABC, abstractmethod

import numpy as np

from shared.world.channel import FloatArray, whole_rate_bps
from shared.world.scenario import Scenario
from simulator.policies.reach import best_in_reach
from simulator.world.observation import Observation

# Within this distance, m, a UAV flies at most at half of the highest velocity.
_NEAR_M = 50.0


def velocity_by_distance(distance_m: float, scenario: Scenario) -> int:
    """0 at the sensor, 1 to 7 m/s within 50 m and 8 to 14 beyond, linear in the distance up to the radio radius."""
    levels = (0, scenario.max_velocity // 2, scenario.max_velocity)
    return int(np.ceil(np.interp(distance_m, (0.0, _NEAR_M, max(scenario.radio_radius_m, _NEAR_M + 1.0)), levels)))


class _PaperScheme(ABC):
    """The sensor in reach with the highest priority; with none in reach, the one heard longest ago."""

    def __init__(self, coordinated: bool = False) -> None:
        self._coordinated = coordinated

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._scenario = scenario

    @abstractmethod
    def priority(self, uav: int, observation: Observation) -> FloatArray:
        """The priority of every sensor, shape ``(J,)``."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        known = taken if self._coordinated else frozenset()
        sensor = best_in_reach(self.priority(uav, observation), observation, known)
        distance = np.hypot(*(observation["sensor_position"][sensor] - observation["position"]))
        return sensor, velocity_by_distance(float(distance), self._scenario)


class EarliestOverflowFirst(_PaperScheme):
    """EOF: the channel's power gain over the expected steps until overflow, ``(W - q_j) / growth_j``.

    The growth, packets a step, is the newest rise of the queue between two beacons that the UAV heard; before the first
    rise it is the scenario's mean arrival rate.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        super().reset(scenario, seed)
        shape = (scenario.uavs, scenario.sensors)
        self._growth = np.full(shape, max(scenario.mean_arrival_rate, 1e-9))
        self._queue, self._heard = np.zeros(shape), np.full(shape, -1)

    def priority(self, uav: int, observation: Observation) -> FloatArray:
        """Power gain over steps."""
        queue, heard = observation["queue"], observation["last_heard"]
        rise = (queue - self._queue[uav]) / np.maximum(heard - self._heard[uav], 1)
        # A fall is a collection, which says nothing about arrivals.
        self._growth[uav] = np.where((self._heard[uav] >= 0) & (rise > 0), rise, self._growth[uav])
        self._queue[uav], self._heard[uav] = queue, heard
        room = np.maximum(self._scenario.queue_capacity - queue, 1e-3)
        return np.asarray(10.0 ** (observation["channel_gain"] / 10.0) * self._growth[uav] / room)


class WeightedQueueChannel(_PaperScheme):
    """WQCS: queue times achievable rate."""

    def priority(self, uav: int, observation: Observation) -> FloatArray:
        """Packets times bit/s."""
        return np.asarray(observation["queue"] * whole_rate_bps(-observation["channel_gain"], self._scenario))
