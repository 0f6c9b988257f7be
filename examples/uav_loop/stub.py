"""A stub of a vehicle, its sensors and its clock, in simulated time."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass

import numpy as np

from examples.uav_loop.vehicle import Beacon, Collected, LocalFrame, Vehicle
from shared.channel import FloatArray, channel_gain_db, link_holds, packets_per_step, rate_bps
from shared.scenario import Point, Scenario
from simulator.world.sensors import Sensors, Streams

GROUND_ABOVE_SEA_M = 1850.0
ENDURANCE_S = 1500.0
# Seconds after the start at which MAVSDK's position is a number.
FIRST_FIX_S = 1.0


@dataclass(frozen=True)
class StubPosition:
    """As in MAVSDK."""

    latitude_deg: float
    longitude_deg: float
    absolute_altitude_m: float
    relative_altitude_m: float


@dataclass(frozen=True)
class StubBattery:
    """As in MAVSDK."""

    remaining_percent: float


class StubWorld:
    """One UAV over a scenario's sensors: clock, telemetry, action and radio in one.

    Packets arrive at the end of each of the scenario's steps. The vehicle flies straight to its target.

    Attributes:
        now_s: simulated seconds since the start.
        place: x and y, metres.
        sent_home: whether it was ordered to return.
    """

    def __init__(self, scenario: Scenario, frame: LocalFrame, start: Point, seed: int, charge: float = 100.0) -> None:
        self.now_s = 0.0
        self.place = start
        self.sent_home = False
        self._scenario, self._frame, self._charge = scenario, frame, charge
        self._sensors = Sensors(scenario, Streams.of(np.random.SeedSequence(seed)))
        self._lost = np.zeros(scenario.sensors, dtype=np.int64)
        self._arrived = 0
        self._speed = 0.0
        self._target = start
        self._altitude_m = scenario.altitude_m

    def vehicle(self) -> Vehicle:
        """The vehicle for the loop."""
        return Vehicle(telemetry=self, action=self, radio=self, clock=self)

    async def sleep(self, delay: float) -> None:
        """Let simulated time pass."""
        await asyncio.sleep(0)
        self.now_s += delay
        gap = math.dist(self.place, self._target)
        share = min(1.0, self._speed * delay / gap) if gap > 0 else 0.0
        (x, y), (to_x, to_y) = self.place, self._target
        self.place = (x + share * (to_x - x), y + share * (to_y - y))
        while self._arrived < min(self.now_s // self._scenario.step_s, self._scenario.steps):
            self._lost += self._sensors.arrive(self._arrived)
            self._arrived += 1

    async def position(self) -> StubPosition:
        """The position; NaN before the first fix, as in MAVSDK."""
        if self.now_s < FIRST_FIX_S:
            return StubPosition(math.nan, math.nan, math.nan, math.nan)
        latitude, longitude = self._frame.degrees(*self.place)
        return StubPosition(latitude, longitude, GROUND_ABOVE_SEA_M + self._altitude_m, self._altitude_m)

    async def battery(self) -> StubBattery:
        """The charge falls evenly with time."""
        return StubBattery(max(0.0, self._charge - 100.0 * self.now_s / ENDURANCE_S))

    async def set_current_speed(self, speed_m_s: float) -> None:
        """Set the speed of the legs that follow."""
        self._speed = speed_m_s

    async def goto_location(
        self, latitude_deg: float, longitude_deg: float, absolute_altitude_m: float, yaw_deg: float
    ) -> None:
        """Fly there from now on."""
        self._target = self._frame.metres(StubPosition(latitude_deg, longitude_deg, absolute_altitude_m, 0.0))
        self._altitude_m = absolute_altitude_m - GROUND_ABOVE_SEA_M

    async def return_to_launch(self) -> None:
        """Note the order."""
        self.sent_home = True

    async def beacons(self) -> dict[int, Beacon]:
        """The sensors within the radio's radius."""
        distance = self._distances()
        gain = channel_gain_db(distance, self._scenario)
        return {
            j: Beacon(int(self._sensors.queue[j]), float(self._sensors.battery[j]), float(gain[j]), int(self._lost[j]))
            for j in np.flatnonzero(distance <= self._scenario.radio_radius_m).tolist()
        }

    async def collect(self, sensor: int) -> Collected:
        """One step's packets, if the link holds."""
        distance = self._distances()[sensor]
        moved = None
        if link_holds(distance, self._scenario):
            budget, rate = packets_per_step(distance, self._scenario), rate_bps(distance, self._scenario)
            moved = self._sensors.transmit(sensor, int(budget), float(rate))
        return Collected(moved or 0, failed=moved is None)

    def _distances(self) -> FloatArray:
        offset = self._sensors.positions - self.place
        return np.hypot(offset[:, 0], offset[:, 1])
