"""Nearest neighbour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.world.scenario import Scenario
from simulator.policies.reach import cruise_velocity, free_sensors, in_reach
from simulator.world.observation import Observation


class NearestNeighbour:
    """Collect from the nearest sensor in reach that this UAV has not chosen yet in its round.

    This is the nearest-neighbour tour of the travelling salesman on fixed trajectories: a UAV cannot fly towards the
    next sensor, only choose it in passing. Each UAV has its own rounds. A new round begins once every free sensor in
    reach was chosen in the current one. With no sensor in reach, the choice is the nearest free one, heard or not, and
    it belongs to no round. The velocity is 7 m/s throughout.
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
