"""The beacons that one UAV has heard, as the observation that the edge and the policies on board decide from."""

from collections.abc import Mapping

import numpy as np

from field.vehicles.radio import Beacon
from shared.world.channel import FloatArray
from shared.world.scenario import Point
from simulator.world.observation import Observation


class LossCounters:
    """What the sensors' own counters of dropped packets have grown by, each from the first beacon heard of it."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}

    def grow(self, counters: Mapping[int, int]) -> dict[int, int]:
        """Take the newest counters; returns the packets that each of these sensors lost since it was last heard.

        A counter that falls belongs to a sensor that has started again: nothing is known of its losses in between.
        """
        grown = {sensor: max(0, count - self._last.get(sensor, count)) for sensor, count in counters.items()}
        self._last.update(counters)
        return grown


class HeardBeacons:
    """The last beacon of each of J sensors; ``sites`` are their positions, ``(J, 2)`` metres."""

    def __init__(self, sites: FloatArray) -> None:
        self._sites = sites
        self._queue, self._battery, self._gain = np.zeros((3, len(sites)))
        self._last_heard = np.full(len(sites), -1)
        self._counters = LossCounters()

    def hear(self, step: int, beacons: Mapping[int, Beacon]) -> int:
        """Store the beacons; returns the packets that these sensors lost since they were last heard."""
        for sensor, beacon in beacons.items():
            self._queue[sensor] = beacon.queue
            self._battery[sensor] = beacon.battery_j
            self._gain[sensor] = beacon.channel_gain_db
            self._last_heard[sensor] = step
        return sum(self._counters.grow({sensor: beacon.lost for sensor, beacon in beacons.items()}).values())

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
