"""The loop's requirements of a vehicle, its radio and its clock: the stub meets them, and so does a real UAV.

``Telemetry`` and ``Action`` are the part of MAVSDK 4 (``mavsdk.asyncio``) that the loop uses, under MAVSDK's own names
and units: angles in degrees (WGS 84), altitudes in metres, percent from 0 to 100, NaN for unknown values.
``TelemetryAsync(system)`` and ``ActionAsync(system)`` fit without a wrapper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pyproj import Proj

from shared.scenario import Point


class Position(Protocol):
    """``mavsdk.plugins.telemetry.Position``."""

    @property
    def latitude_deg(self) -> float: ...

    @property
    def longitude_deg(self) -> float: ...

    @property
    def absolute_altitude_m(self) -> float: ...

    @property
    def relative_altitude_m(self) -> float: ...


class Battery(Protocol):
    """``mavsdk.plugins.telemetry.Battery``."""

    @property
    def remaining_percent(self) -> float: ...


class Telemetry(Protocol):
    """``mavsdk.asyncio.plugins.telemetry.TelemetryAsync``."""

    async def position(self) -> Position:
        """The newest position."""
        ...

    async def battery(self) -> Battery:
        """The newest state of the vehicle's battery."""
        ...


class Action(Protocol):
    """``mavsdk.asyncio.plugins.action.ActionAsync``."""

    async def set_current_speed(self, speed_m_s: float) -> None:
        """Set the speed of the legs that follow."""
        ...

    async def goto_location(
        self, latitude_deg: float, longitude_deg: float, absolute_altitude_m: float, yaw_deg: float
    ) -> None:
        """Fly there; altitude above mean sea level, yaw clockwise from north. Returns when the order is taken."""
        ...

    async def return_to_launch(self) -> None:
        """Fly home and land."""
        ...


@dataclass(frozen=True)
class Beacon:
    """A sensor's last beacon. ``lost`` counts the packets that it has dropped since it was set up."""

    queue: int
    battery_j: float
    channel_gain_db: float
    lost: int


@dataclass(frozen=True)
class Collected:
    """The result of collecting from a sensor."""

    packets: int
    failed: bool


class Radio(Protocol):
    """The data link to the ground sensors, which MAVLink does not cover."""

    async def beacons(self) -> dict[int, Beacon]:
        """The sensors in range, by index."""
        ...

    async def collect(self, sensor: int) -> Collected:
        """Fetch a sensor's waiting packets, as many as the link carries in one step."""
        ...


class Clock(Protocol):
    """The vehicle's time: the module ``asyncio`` fits."""

    async def sleep(self, delay: float) -> None:
        """Wait so many seconds."""
        ...


@dataclass(frozen=True)
class Vehicle:
    """One UAV: its autopilot, its link to the sensors, and its clock."""

    telemetry: Telemetry
    action: Action
    radio: Radio
    clock: Clock


class LocalFrame:
    """A plane on the globe: x metres east and y metres north of an origin, azimuthal equidistant (WGS 84).

    Scenarios count from their area's south-west corner, so let that be the origin. MAVLink's local NED frame is
    ``(y, x, -altitude)`` from wherever the autopilot was started; degrees do not depend on that.
    """

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self._plane = Proj(proj="aeqd", ellps="WGS84", units="m", lat_0=latitude_deg, lon_0=longitude_deg)

    def metres(self, position: Position) -> Point:
        """x and y of a position."""
        x, y = self._plane(position.longitude_deg, position.latitude_deg)
        return float(x), float(y)

    def degrees(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of a point."""
        longitude, latitude = self._plane(x, y, inverse=True)
        return float(latitude), float(longitude)


def yaw_deg(start: Point, end: Point) -> float:
    """The heading from one point to another, clockwise from north, 0..360."""
    east, north = end[0] - start[0], end[1] - start[1]
    return float(np.degrees(np.arctan2(east, north)) % 360.0)
