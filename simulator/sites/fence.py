"""A geofence of a world: an area that no UAV may leave, or one that none may enter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.channel import FloatArray
from shared.scenario import Point

FenceRole = Literal["fence", "no_fly"]


@dataclass(frozen=True)
class Fence:
    """An area in one plane; coordinates in the plane's unit.

    Attributes:
        role: ``fence``: not to be left; ``no_fly``: not to be entered.
        points: the corners of a polygon, closed (the last is the first), or the centre of a circle alone.
        radius: of a circle, else 0.
    """

    role: FenceRole
    points: tuple[Point, ...]
    radius: float = 0.0

    def allows(self, position: Point) -> bool:
        """Whether a UAV may be there."""
        return self._contains(position) == (self.role == "fence")

    def first_breach(self, path: Sequence[Point]) -> int | None:
        """The index of the first waypoint of a path that is not allowed, or to which the way is not; else ``None``."""
        legs = np.array(list(zip(path, path[1:], strict=False)), dtype=np.float64).reshape(-1, 2, 2)
        if not self.allows(path[0]):
            return 0
        broken = self._circle_breached(legs) if self.radius else self._ring_crossed(legs)
        ends = np.array([not self.allows(point) for point in path[1:]], dtype=np.bool_)
        found = np.flatnonzero(broken | ends)
        return int(found[0]) + 1 if len(found) else None

    def _contains(self, position: Point) -> bool:
        x, y = position
        if self.radius:
            return bool(np.hypot(x - self.points[0][0], y - self.points[0][1]) <= self.radius)
        ring = np.array(self.points)
        (x1, y1), (x2, y2) = ring[:-1].T, ring[1:].T
        spans = (y1 > y) != (y2 > y)
        # An edge that does not span y is level or elsewhere: its quotient is not looked at.
        rise = np.where(spans, y2 - y1, 1.0)
        return bool(np.count_nonzero(spans & (x < x1 + (y - y1) * (x2 - x1) / rise)) % 2)

    def _circle_breached(self, legs: FloatArray) -> NDArray[np.bool_]:
        if self.role == "fence":
            # A circle is convex: a leg between two points inside stays inside.
            return np.zeros(len(legs), dtype=np.bool_)
        start, way, centre = legs[:, 0], legs[:, 1] - legs[:, 0], np.array(self.points[0])
        length = np.sum(way * way, axis=1)
        along = np.sum((centre - start) * way, axis=1) / np.where(length > 0, length, 1.0)
        gap = start + np.clip(along, 0.0, 1.0)[:, None] * way - centre
        breached: NDArray[np.bool_] = np.hypot(gap[:, 0], gap[:, 1]) <= self.radius
        return breached

    def _ring_crossed(self, legs: FloatArray) -> NDArray[np.bool_]:
        ring = np.array(self.points)
        a, b = legs[:, None, 0], legs[:, None, 1]
        c, d = ring[None, :-1], ring[None, 1:]
        crossed = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        return np.asarray(crossed.any(axis=1))


def _side(start: ArrayLike, end: ArrayLike, point: ArrayLike) -> FloatArray:
    """Twice the signed area of a triangle, hence the side of a line on which a point is."""
    a, b, p = (np.asarray(value, dtype=np.float64) for value in (start, end, point))
    (dx, dy), (px, py) = np.moveaxis(b - a, -1, 0), np.moveaxis(p - a, -1, 0)
    return np.asarray(dx * py - dy * px)
