"""A simulated airframe that flies a mission's waypoints by the clock; the MAVLink peers in the tests use it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import TypeVar

EARTH_M = 6_371_008.8
HEIGHT_M = 100.0
GROUND_M = 1850.0


T = TypeVar("T")


def without_repeats(commands: Iterable[T]) -> list[T]:
    """The commands without consecutive repetitions: MAVSDK repeats a command until it is acknowledged."""
    return [command for command, _ in groupby(commands)]


@dataclass(frozen=True)
class Item:
    """A mission item as MAVLink sends it."""

    command: int
    latitude: float
    longitude: float
    parameters: tuple[float, float] = (0.0, 0.0)


class Airframe:
    """Flies round its waypoints (command 16) and back to the first, at a speed that is set.

    It computes on a sphere and with its own projection, and shares no code with the product.

    Attributes:
        speed: m/s, commanded.
        top, accelerates: m/s and m/s^2; a real ArduCopter accepts 14 m/s, never exceeds 10.97 (REALITY.md, B2), and
            accelerates along its path at WPNAV_ACCEL, 2.5 m/s^2 unless set.
        ground_speed: m/s, flown.
        mode: `mission` flies; every other one stays in place.
        paused: it stays in place in its mission.
        flown_m: metres along the path since its beginning.
        trace: every position that it reported, latitude and longitude.
    """

    def __init__(
        self,
        items: list[Item],
        start_m: float = 0.0,
        speedup: float = 1.0,
        speed: float = 5.0,
        top: float = math.inf,
        accelerates: float = math.inf,
    ) -> None:
        places = [(item.latitude, item.longitude) for item in items if item.command == 16]
        self._north, self._east = math.radians(places[0][0]), math.radians(places[0][1])
        ring = [self._metres(*place) for place in (*places, places[0])]
        self._legs = list(pairwise(ring))
        self.length_m = sum(math.dist(*leg) for leg in self._legs)
        self.speed, self.mode, self.armed, self.flown_m = speed, "mission", True, start_m
        self.ground_speed, self.top, self.accelerates = min(speed, top), top, accelerates
        self.paused = False
        self.drift_m = 0.0
        # The height of a climb in place, as ArduPilot flies it in mode AUTO; None after it.
        self.climbs_m: float | None = None
        self.trace: list[tuple[float, float]] = []
        self._speedup, self._at_s = speedup, time.monotonic()
        self._lock = threading.Lock()

    def position(self) -> tuple[float, float]:
        """Latitude and longitude now."""
        with self._lock:
            now = time.monotonic()
            self._fly((now - self._at_s) * self._speedup)
            self._at_s = now
            x, y = self._at(self.flown_m % self.length_m)
            north = self._north + (y + self.drift_m) / EARTH_M
            place = math.degrees(north), math.degrees(self._east + x / (EARTH_M * math.cos(self._north)))
            self.trace.append(place)
            return place

    def _fly(self, seconds: float) -> None:
        moves = self.mode == "mission" and not self.paused and self.climbs_m is None
        target = min(self.speed, self.top) if moves else 0.0
        before, most = self.ground_speed, self.accelerates * seconds if seconds else 0.0
        self.ground_speed += min(max(target - before, -most), most)
        ramp_s = min(seconds, abs(self.ground_speed - before) / self.accelerates)
        self.flown_m += (before + self.ground_speed) / 2 * ramp_s + self.ground_speed * (seconds - ramp_s)

    def height_m(self) -> float:
        """The height above the take-off place."""
        return HEIGHT_M if self.climbs_m is None else self.climbs_m

    def _metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        north, east = math.radians(latitude) - self._north, math.radians(longitude) - self._east
        return east * EARTH_M * math.cos(self._north), north * EARTH_M

    def _at(self, along: float) -> tuple[float, float]:
        for (x1, y1), (x2, y2) in self._legs:
            length = math.dist((x1, y1), (x2, y2))
            if along <= length:
                share = along / length if length else 0.0
                return x1 + share * (x2 - x1), y1 + share * (y2 - y1)
            along -= length
        return self._legs[-1][1]
