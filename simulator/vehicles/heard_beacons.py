"""The beacons that one UAV has heard, as the observation that the edge and the policies on board decide from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from shared.channel import FloatArray
from shared.scenario import Point
from simulator.vehicles.radio import Beacon
from simulator.world import Observation


class HeardBeacons:
    """The last beacon of each of J sensors; ``sites`` are their positions, ``(J, 2)`` metres."""

    def __init__(self, sites: FloatArray) -> None:
        self._sites = sites
        self._queue, self._battery, self._gain = np.zeros((3, len(sites)))
        self._last_heard = np.full(len(sites), -1)
        self._lost: dict[int, int] = {}

    def hear(self, step: int, beacons: Mapping[int, Beacon]) -> int:
        """Store the beacons; returns the packets that these sensors lost since they were last heard."""
        lost = 0
        for sensor, beacon in beacons.items():
            self._queue[sensor] = beacon.queue
            self._battery[sensor] = beacon.battery_j
            self._gain[sensor] = beacon.channel_gain_db
            self._last_heard[sensor] = step
            lost += beacon.lost - self._lost.get(sensor, beacon.lost)
            self._lost[sensor] = beacon.lost
        return lost

    def observation(self, step: int, position: Point, progress_m: float) -> Observation:
        """The observation of a UAV there, at that arc length of its trajectory."""
        return Observation(
            step=np.array([step]),
            position=np.array(position),
            progress=np.array([progress_m]),
            sensor_position=self._sites,
            queue=self._queue.copy(),
            battery=self._battery.copy(),
            channel_gain=self._gain.copy(),
            last_heard=self._last_heard.copy(),
        )
