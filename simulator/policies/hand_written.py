"""The hand-written policies; but for the random one, all fly at 7 m/s throughout."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, path_loss_db
from shared.world.scenario import Scenario
from simulator.policies.reach import best_in_reach, cruise_velocity, free_sensors, in_reach
from simulator.world.observation import Observation


class _HighestScore(ABC):
    """Collect from the sensor in reach with the highest score; with none in reach, from the one heard longest ago."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._scenario = scenario

    @abstractmethod
    def score(self, observation: Observation) -> FloatArray:
        """The score of every sensor, shape ``(J,)``."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        return best_in_reach(self.score(observation), observation, taken), cruise_velocity(self._scenario)


class LongestQueue(_HighestScore):
    """The sensor in reach with the longest queue: the first to overflow, if packets arrive at one rate everywhere."""

    def score(self, observation: Observation) -> FloatArray:
        """The queue."""
        return observation["queue"]


class QueueAndChannel(_HighestScore):
    """The sensor in reach with the highest ``0.5 q_j / W + 0.5 h_j``.

    ``h_j`` is the channel gain scaled to 0 at the path-loss threshold and 1 right below the UAV.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        super().reset(scenario, seed)
        self._span = max(scenario.path_loss_limit_db - float(path_loss_db(0.0, scenario)), 1e-9)

    def score(self, observation: Observation) -> FloatArray:
        """The weighted sum."""
        channel = np.clip((observation["channel_gain"] + self._scenario.path_loss_limit_db) / self._span, 0.0, 1.0)
        return 0.5 * observation["queue"] / self._scenario.queue_capacity + 0.5 * channel


class MaximumGain(_HighestScore):
    """The sensor in reach with the highest channel gain.

    The gain depends only on the distance, so this is the sensor closest to the UAV, whatever its queue and its visits.
    """

    def score(self, observation: Observation) -> FloatArray:
        """The channel gain."""
        return observation["channel_gain"]


class NearestNeighbour:
    """Collect from the nearest sensor in reach that this UAV has not chosen yet in its round.

    This is the nearest-neighbour tour of the travelling salesman on fixed trajectories: a UAV cannot fly towards the
    next sensor, only choose it in passing. Each UAV has its own rounds. A new round begins once every free sensor in
    reach was chosen in the current one. With no sensor in reach, the choice is the nearest free one, heard or not, and
    it belongs to no round.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._velocity = cruise_velocity(scenario)
        self._chosen: NDArray[np.bool_] = np.zeros((scenario.uavs, scenario.sensors), dtype=np.bool_)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        distance = np.hypot(*(observation["sensor_position"] - observation["position"]).T)
        reachable = in_reach(observation, taken)
        if not reachable.any():
            return _first(distance, free_sensors(len(distance), taken)), self._velocity
        if not (reachable & ~self._chosen[uav]).any():
            self._chosen[uav] = False
        sensor = _first(distance, reachable & ~self._chosen[uav])
        self._chosen[uav, sensor] = True
        return sensor, self._velocity


def _first(distance: NDArray[np.float64], among: NDArray[np.bool_]) -> int:
    return int(np.argmin(np.where(among, distance, np.inf)))


class RoundRobin:
    """Every UAV cycles through the sensors, in range or not; UAV i starts at sensor ``i J / I``.

    Sensors taken by other UAVs are skipped.
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
