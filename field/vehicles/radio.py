"""The data link to the ground sensors, which MAVLink does not have: its interface, a simulated one, heard beacons."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shared.kit.own_code import imported
from shared.world.channel import FloatArray, Links, channel_gain_db
from shared.world.scenario import Point
from shared.world.step_rule import joules_a_packet, transfer
from simulator.errors import UsageError
from simulator.sites.site import Site
from simulator.world.observation import Observation
from simulator.world.sensors import Sensors, Streams

SIMULATED = "simulated"


@dataclass(frozen=True)
class Spot:
    """Where and when a UAV uses its radio.

    Attributes:
        uav: its index among the world's trajectories.
        step: the waypoint, from 0; all UAVs of a flight are at the same one.
        position: x and y in the world's plane, metres.
        degrees: longitude and latitude.
    """

    uav: int
    step: int
    position: Point
    degrees: Point


@dataclass(frozen=True)
class Beacon:
    """A sensor's beacon. ``lost`` counts the packets that it has dropped since it was set up."""

    queue: int
    battery_j: float
    channel_gain_db: float
    lost: int


@dataclass(frozen=True)
class Collected:
    """The result of collecting from a sensor: packets, and whether the transmission failed."""

    packets: int
    failed: bool


class Radio(Protocol):
    """The radios of a flight's UAVs. A sensor's index is its place in ``world.geojson``."""

    async def beacons(self, spot: Spot) -> Mapping[int, Beacon]:
        """The newest beacon of each sensor in range; called once a UAV and step."""

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        """Fetch a sensor's waiting packets, as many as the link carries in one step; called at the step's end."""


class SimulatedRadio:
    """The sensors of a site over the scenario's mean path loss; the same queues and arrivals as a simulated mission's.

    A sensor serves one UAV a step. Packets arrive between two steps. What the model leaves out
    (:class:`shared.world.scenario.Unmodelled`) is not simulated, except bursts.
    """

    def __init__(self, site: Site, seed: int) -> None:
        self._scenario = site.scenario
        self._sensors = Sensors.draw(site.scenario, Streams.of(np.random.SeedSequence(seed)), site.arrivals)
        self._step = 0
        self._served: set[int] = set()

    @property
    def lost(self) -> int:
        """Packets that all sensors have lost so far."""
        return int(self._sensors.lost.sum())

    async def beacons(self, spot: Spot) -> Mapping[int, Beacon]:
        """The sensors within the radio radius."""
        self._arrive(spot.step)
        distance = self._distances(spot.position)
        gain = channel_gain_db(distance, self._scenario)
        heard = np.flatnonzero(distance <= self._scenario.radio_radius_m).tolist()
        return {j: self._beacon(j, float(gain[j])) for j in heard}

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        """One step's packets, if the link carries data and the sensor has served no UAV in this step."""
        self._arrive(spot.step)
        link = Links.at(self._distances(spot.position)[[sensor]], self._scenario)
        holds, joules = link.hold & (sensor not in self._served), joules_a_packet(link.rate_bps, self._scenario)
        now, named = self._sensors, np.array([sensor])
        served, moved = transfer(now.queue, now.battery, named, holds, link.packets, joules)
        if served[0]:
            self._served.add(sensor)
        return Collected(int(moved[0]), failed=not served[0])

    def _arrive(self, step: int) -> None:
        """Let the packets arrive that a later step finds."""
        while self._step < min(step, self._scenario.steps):
            self._sensors.arrive(self._step, self._scenario.queue_capacity)
            self._step += 1
            self._served.clear()

    def _beacon(self, sensor: int, gain_db: float) -> Beacon:
        now = self._sensors
        return Beacon(int(now.queue[sensor]), float(now.battery[sensor]), gain_db, int(now.lost[sensor]))

    def _distances(self, position: Point) -> FloatArray:
        offset = self._sensors.positions - position
        return np.hypot(offset[:, 0], offset[:, 1])


def radio_named(name: str, site: Site, seed: int) -> Radio:
    """The radio of the option ``--radio``: ``simulated``, or ``MODULE:NAME``, a callable that takes the site.

    Raises:
        UsageError: there is no such module or callable.
    """
    if name == SIMULATED:
        return SimulatedRadio(site, seed)
    if ":" not in name:
        raise UsageError(f"--radio {name}: write simulated, or MODULE:NAME of your own, such as my_radio:Radio")
    try:
        make: Callable[[Site], Radio] = imported(name)
    except ValueError as error:
        raise UsageError(f"--radio {name}: {error}") from None
    return make(site)


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
