"""The hand-written policies.

EOF and WQCS are the paper's; docs/results/paper.md has our readings where its text is open. Their velocity follows
the distance to the chosen sensor, by the velocity strategy of the paper's prompt. Its UAVs choose independently; a
coordinated scheme also leaves out the sensors that earlier UAVs of the step chose. All others fly at 7 m/s throughout,
but for the random one.
"""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, path_loss_db, whole_rate_bps
from shared.world.scenario import Scenario
from simulator.world.observation import Observation

# Within this distance, m, a UAV flies at most at half of the highest velocity.
_NEAR_M = 50.0


def cruise_velocity(scenario: Scenario) -> int:
    """The constant velocity of a policy that does not control it: 7 m/s, half of the paper's range."""
    return min(7, scenario.max_velocity)


def free_sensors(count: int, taken: frozenset[int]) -> NDArray[np.bool_]:
    """Mask of the sensors that no earlier UAV of this step chose, shape ``(J,)``; all of them if none is free."""
    free = np.ones(count, dtype=np.bool_)
    free[list(taken)] = False
    return free if free.any() else ~free


def in_reach(observation: Observation, taken: frozenset[int]) -> NDArray[np.bool_]:
    """Mask of the free sensors in radio range now, shape ``(J,)``."""
    heard_now = observation["last_heard"] == observation["step"]
    return np.asarray(heard_now & free_sensors(len(observation["queue"]), taken))


def longest_unheard(observation: Observation, taken: frozenset[int]) -> int:
    """The free sensor heard longest ago, never heard ones first; of equals the nearest."""
    free = np.flatnonzero(free_sensors(len(observation["queue"]), taken))
    distance = np.hypot(*(observation["sensor_position"][free] - observation["position"]).T)
    return int(free[np.lexsort((distance, observation["last_heard"][free]))[0]])


class _HighestScore(ABC):
    """Collect from the sensor in reach with the highest score; with none in reach, from the one heard longest ago.

    Of equals the lowest index wins.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._scenario = scenario

    @abstractmethod
    def score(self, uav: int, observation: Observation) -> FloatArray:
        """The score of every sensor, shape ``(J,)``."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        score, reachable = self.score(uav, observation), in_reach(observation, taken)
        velocity = cruise_velocity(self._scenario)
        if not reachable.any():
            return longest_unheard(observation, taken), velocity
        return int(np.argmax(np.where(reachable, score, -np.inf))), velocity


class LongestQueue(_HighestScore):
    """The sensor in reach with the longest queue: the first to overflow, if packets arrive at one rate everywhere."""

    def score(self, uav: int, observation: Observation) -> FloatArray:
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

    def score(self, uav: int, observation: Observation) -> FloatArray:
        """The weighted sum."""
        channel = np.clip((observation["channel_gain"] + self._scenario.path_loss_limit_db) / self._span, 0.0, 1.0)
        return 0.5 * observation["queue"] / self._scenario.queue_capacity + 0.5 * channel


class MaximumGain(_HighestScore):
    """The sensor in reach with the highest channel gain.

    The gain depends only on the distance, so this is the sensor closest to the UAV, whatever its queue and its visits.
    """

    def score(self, uav: int, observation: Observation) -> FloatArray:
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


def velocity_by_distance(distance_m: float, scenario: Scenario) -> int:
    """0 at the sensor, 1 to 7 m/s within 50 m and 8 to 14 beyond, linear in the distance up to the radio radius."""
    levels = (0, scenario.max_velocity // 2, scenario.max_velocity)
    return int(np.ceil(np.interp(distance_m, (0.0, _NEAR_M, max(scenario.radio_radius_m, _NEAR_M + 1.0)), levels)))


class _PaperScheme(_HighestScore):
    """The velocity by the distance to the sensor, and each UAV for itself unless ``coordinated``."""

    def __init__(self, coordinated: bool = False) -> None:
        self._coordinated = coordinated

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        sensor, _ = super().decide(uav, observation, taken if self._coordinated else frozenset())
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

    def score(self, uav: int, observation: Observation) -> FloatArray:
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

    def score(self, uav: int, observation: Observation) -> FloatArray:
        """Packets times bit/s."""
        return np.asarray(observation["queue"] * whole_rate_bps(-observation["channel_gain"], self._scenario))
