"""Simulated sensors and their radios, for trials: the vehicles are real, the packets are not."""

from collections.abc import Callable, Mapping

import numpy as np

from field.vehicles.radio import Beacon, Collected, Radio, Spot
from shared.kit.own_code import imported
from shared.world.channel import FloatArray, Links, channel_gain_db
from shared.world.scenario import Point
from shared.world.step_rule import joules_a_packet, transfer
from simulator.errors import UsageError
from simulator.sites.site import Site
from simulator.world.sensors import Sensors, Streams


class SimulatedRadio:
    """The sensors of a site over the scenario's mean path loss; the same queues and arrivals as a simulated mission's.

    A sensor serves one UAV a step. Packets arrive between two steps. What the model leaves out
    (:class:`shared.world.unmodelled.Unmodelled`) is not simulated, except bursts.
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


SIMULATED = "simulated"


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
