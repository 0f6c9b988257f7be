"""Rules that the hand-written policies share: the sensors in reach, and the choice without any."""

import numpy as np
from numpy.typing import NDArray

from shared.world.scenario import Scenario
from simulator.world.observation import Observation


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


def best_in_reach(score: NDArray[np.float64], observation: Observation, taken: frozenset[int]) -> int:
    """The sensor in reach with the highest score; with none in reach, the one heard longest ago.

    Args:
        score: shape ``(J,)``; of equals the lowest index wins.
    """
    reachable = in_reach(observation, taken)
    if not reachable.any():
        return longest_unheard(observation, taken)
    return int(np.argmax(np.where(reachable, score, -np.inf)))
