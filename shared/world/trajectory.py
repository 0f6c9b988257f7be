"""Trajectories, for the edge and the simulator: the position at an arc length, and the arc length of a position."""

import math
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from shared.world.channel import FloatArray
from shared.world.scenario import Point, Scenario

# The largest error of a reported position, metres: five standard deviations of a poor receiver.
_POSITION_ERROR_M = 25.0
# The largest distance from a trajectory that counts as on it, metres.
_TOLERANCE_M = 10.0


class Trajectory(Protocol):
    """A closed curve, flown in one direction. After ``length_m`` of arc a UAV is at the same point again."""

    @property
    def length_m(self) -> float: ...

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest x and y, each ``(2,)``, metres."""

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """The points at arc lengths ``(...)`` from the trajectory's beginning, ``(..., 2)``, metres."""

    def locate(self, position: Point) -> tuple[float, float]:
        """The arc length of the trajectory's point nearest to a position, and the gap between the two, metres."""


class Circle:
    """A circle flown counter-clockwise; it begins due east of its centre. The radius is above 0."""

    def __init__(self, centre: Point, radius_m: float) -> None:
        self._centre: FloatArray = np.array(centre, dtype=np.float64)
        self._radius_m = float(radius_m)
        self.length_m = 2.0 * math.pi * self._radius_m

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest x and y."""
        return self._centre - self._radius_m, self._centre + self._radius_m

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """``centre + radius (cos, sin)(progress / radius)``."""
        angle = np.asarray(progress_m, dtype=np.float64) / self._radius_m
        # For a few numbers np.stack takes several times as long.
        points = np.empty((*angle.shape, 2))
        points[..., 0], points[..., 1] = np.cos(angle), np.sin(angle)
        return self._centre + self._radius_m * points

    def locate(self, position: Point) -> tuple[float, float]:
        """By the position's bearing from the centre."""
        x, y = position[0] - self._centre[0], position[1] - self._centre[1]
        progress = math.atan2(y, x) % (2.0 * math.pi) * self._radius_m
        return progress, abs(math.hypot(x, y) - self._radius_m)


class Polyline:
    """Straight legs from waypoint to waypoint, ``(N, 2)`` metres.

    If the last waypoint is the first, the UAV flies laps. Otherwise it flies there and back, and ``length_m`` is twice
    the legs' length.

    Raises:
        ValueError: fewer than two different waypoints.
    """

    def __init__(self, waypoints: ArrayLike) -> None:
        points = np.array(waypoints, dtype=np.float64)
        if not np.array_equal(points[0], points[-1]):
            points = np.concatenate((points, points[-2::-1]))
        legs = np.hypot(*np.diff(points, axis=0).T)
        if not legs.sum() > 0:
            raise ValueError("a trajectory needs at least two different waypoints")
        # A leg of length 0 would be two points at one arc length.
        self._points: FloatArray = points[np.concatenate(([True], legs > 0))]
        self._reached: FloatArray = np.concatenate(([0.0], np.cumsum(legs[legs > 0])))
        self.length_m = float(self._reached[-1])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest x and y."""
        return self._points.min(axis=0), self._points.max(axis=0)

    def at(self, progress_m: ArrayLike) -> FloatArray:
        """By linear interpolation along the legs."""
        flown = np.mod(np.asarray(progress_m, dtype=np.float64), self.length_m)
        return np.stack([np.interp(flown, self._reached, self._points[:, axis]) for axis in (0, 1)], axis=-1)

    def locate(self, position: Point) -> tuple[float, float]:
        """On the nearest leg; where the ways there and back coincide, on the way there."""
        start, leg = self._points[:-1], np.diff(self._points, axis=0)
        along = np.sum((np.asarray(position) - start) * leg, axis=1) / np.sum(leg * leg, axis=1)
        foot = start + np.clip(along, 0.0, 1.0)[:, None] * leg
        gaps = np.hypot(*(foot - position).T)
        nearest = int(np.argmin(gaps))
        return float(self._reached[nearest] + math.dist(foot[nearest], start[nearest])), float(gaps[nearest])


@lru_cache(maxsize=64)
def trajectories(scenario: Scenario) -> tuple[Trajectory, ...]:
    """One trajectory a UAV: the scenario's routes if it has any, else its circles."""
    if scenario.routes:
        return tuple(Polyline(route) for route in scenario.routes)
    return tuple(Circle(centre, scenario.lap_radius_m) for centre in scenario.lap_centres)


def progress_of(trajectory: Trajectory, position: Point, reported_m: float | None = None) -> float | None:
    """A UAV's progress along its trajectory, metres; ``None`` for a UAV off its trajectory.

    Args:
        position: metres.
        reported_m: the UAV's own report of its progress, which counts if the trajectory passes its position there, up
            to the error of a position. It decides between the ways there and back.
    """
    if reported_m is not None and math.dist(trajectory.at(reported_m), position) <= _POSITION_ERROR_M:
        return reported_m
    progress, gap = trajectory.locate(position)
    return progress if gap <= _TOLERANCE_M else None
