"""A vehicle and a clock in simulated time, for tests without MAVLink."""

from __future__ import annotations

import asyncio
from dataclasses import replace

from field.errors import VehicleError
from field.vehicles.field_flight import MissionClock
from field.vehicles.mavlink_vehicle import FlightMode, VehicleState
from shared.world.trajectory import trajectories
from simulator.sites.plans.mission_path import MissionItem
from simulator.sites.site import Site


class SimulatedClock(MissionClock):
    """A clock that advances only in ``until``."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def now(self) -> float:
        return self.now_s

    async def until(self, time_s: float) -> None:
        await asyncio.sleep(0)
        self.now_s = max(self.now_s, time_s)


class StubVehicle:
    """Flies its trajectory at the speed that it is commanded, times ``wind``.

    Attributes:
        commands: every command.
        lands_at_s, flies_on_at_s: the start and the end of its landing.
        top: its highest ground speed, m/s, even if it acknowledges a higher one.
        shift_m: the northward error of its reported position.
        battery_percent: the battery level that it reports.
    """

    def __init__(self, site: Site, uav: int, clock: SimulatedClock, wind: float = 1.0) -> None:
        self.name = f"stub {uav}"
        self.commands: list[str | float] = []
        self.lands_at_s = self.flies_on_at_s = self.top = float("inf")
        self.shift_m = 0.0
        self.battery_percent: float | None = None
        self.deaf = self.waits_in_mission = False
        self.mode: FlightMode = "mission"
        self.flown_m = 0.0
        self._site, self._path, self._clock, self._wind = site, trajectories(site.scenario)[uav], clock, wind
        self._speed, self._at_s = 5.0, clock.now()

    async def state(self) -> VehicleState:
        """The current state."""
        self._advance()
        assert self._site.frame is not None
        x, y = self._path.at(self.flown_m).tolist()
        longitude, latitude = self._site.frame.degrees([(x, y + self.shift_m)])[0].tolist()
        speed = self._ground_speed if self.mode == "mission" else 0.0
        state = VehicleState(True, True, self.mode, (longitude, latitude), 100.0, speed_m_s=speed)
        state = replace(state, battery_percent=self.battery_percent)
        landing = self.lands_at_s <= self._clock.now() < self.flies_on_at_s
        return replace(state, mode="landing") if landing else state

    async def mission(self) -> list[MissionItem]:
        """No items."""
        return []

    async def set_speed(self, speed_m_s: float) -> None:
        """Set the speed."""
        self._obey(speed_m_s)
        self._speed = speed_m_s

    async def hold(self) -> None:
        """Hold the position."""
        self._obey("hold")
        self.mode = "hold"

    async def resume(self) -> None:
        """Resume the mission."""
        self._obey("resume")
        self.mode = "mission"

    @property
    def _ground_speed(self) -> float:
        return min(self._speed * self._wind, self.top)

    def _obey(self, command: str | float) -> None:
        self._advance()
        self.commands.append(command)
        if self.deaf:
            raise VehicleError(f"{self.name} did not do {command}: TIMEOUT")

    def _advance(self) -> None:
        if self.mode == "mission":
            self.flown_m += self._ground_speed * (self._clock.now() - self._at_s)
        self._at_s = self._clock.now()
