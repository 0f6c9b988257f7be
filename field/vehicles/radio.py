"""The interface of the data link to the ground sensors, which MAVLink does not have."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from shared.world.scenario import Point


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
        ...

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        """Fetch a sensor's waiting packets, as many as the link carries in one step; called at the step's end."""
        ...
