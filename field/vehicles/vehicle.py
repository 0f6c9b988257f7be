"""The interface of a vehicle and its autopilot that the flight of real UAVs uses."""

from dataclasses import dataclass
from typing import Literal, Protocol

from shared.world.scenario import Point
from simulator.sites.plans.mission_path import MissionItem

# `mission`: it flies its uploaded mission; `hold`: it hovers or circles in place; `landing`: it lands or returns.
FlightMode = Literal["mission", "hold", "landing", "other"]


@dataclass(frozen=True)
class VehicleState:
    """The newest telemetry of a vehicle.

    Attributes:
        connected: whether heartbeats arrive.
        armed: as the autopilot says.
        mode: the autopilot's flight mode.
        position: longitude and latitude, degrees; ``None`` without a fix, and while none arrives.
        height_m: above the take-off place.
    """

    connected: bool
    armed: bool
    mode: FlightMode
    position: Point | None
    height_m: float = 0.0


class Vehicle(Protocol):
    """A vehicle with an autopilot that has a mission. The commands are a speed, wait, and go on.

    Every method may raise :class:`simulator.errors.VehicleError`.
    """

    name: str

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
