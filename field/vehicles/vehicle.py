"""The interface of a vehicle and its autopilot that the flight of real UAVs uses."""

from dataclasses import dataclass
from typing import Literal, Protocol

from shared.world.scenario import Point
from simulator.sites.plans.mission_path import MissionItem

# `mission`: it flies its uploaded mission; `hold`: it hovers or circles in place; `returning`: to where it took off.
FlightMode = Literal["mission", "hold", "landing", "returning", "other"]


@dataclass(frozen=True)
class VehicleState:
    """The newest telemetry of a vehicle.

    Attributes:
        connected: whether heartbeats arrive.
        armed: as the autopilot says; ``None`` before its first heartbeat.
        mode: the autopilot's flight mode.
        position: longitude and latitude, degrees; ``None`` without a fix, and while none arrives.
        height_m: above the autopilot's home, which may be another place than that of its take-off.
        in_air: the autopilot's landed state; ``None`` where it says none.
        speed_m_s: over the ground; ``None`` where the autopilot says none.
        battery_percent: that is left; ``None`` where the autopilot says none.
    """

    connected: bool
    armed: bool | None
    mode: FlightMode
    position: Point | None
    height_m: float = 0.0
    in_air: bool | None = None
    speed_m_s: float | None = None
    battery_percent: float | None = None


class Vehicle(Protocol):
    """A vehicle with an autopilot that has a mission. The commands are a speed, wait, and go on.

    Every method may raise :class:`field.errors.VehicleError`.

    Attributes:
        name: for messages.
        waits_in_mission: whether the mode stays ``mission`` while it waits.
    """

    name: str
    waits_in_mission: bool

    async def state(self) -> VehicleState:
        """The newest telemetry; never waits for the vehicle."""
        ...

    async def mission(self) -> list[MissionItem]:
        """The mission on board."""
        ...

    async def set_speed(self, speed_m_s: float) -> None:
        """Fly along the mission at this ground speed, above 0."""
        ...

    async def hold(self) -> None:
        """Wait in place, in the mission."""
        ...

    async def resume(self) -> None:
        """Go on with the mission."""
        ...
