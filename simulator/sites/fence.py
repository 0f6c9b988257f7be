"""A geofence of a world: an area that no UAV may leave, or one that none may enter."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import FloatArray
from shared.world.scenario import Point

FenceRole = Literal["fence", "no_fly"]
# What is this near to a boundary touches it, metres: a world's places are rounded to a millimetre.
_TOUCHES = 0.01
# Pairs of a leg and an edge in memory at the same time.
_MOST_PAIRS = 200_000


@dataclass(frozen=True)
class Fence:
    """An area in one plane; coordinates in the plane's unit.

    Attributes:
        role: ``fence``: not to be left; ``no_fly``: not to be entered.
        points: the corners of a polygon, closed (the last is the first), or only the centre of a circle.
        radius: of a circle, else 0.
        name: for people.
    """

    role: FenceRole
    points: tuple[Point, ...]
    radius: float = 0.0
    name: str | None = None

    def allows(self, position: Point) -> bool:
        """Whether a UAV may be there; a boundary belongs to its area."""
        return bool(self._contains(np.array([position], dtype=np.float64))[0]) == (self.role == "fence")

    def first_breach(self, path: Sequence[Point]) -> int | None:
        """The index of the first waypoint of a path that is not allowed, or to which the way is not; else ``None``.

        A leg breaks a ``no_fly`` area that it touches, also in a corner or along an edge. It may touch the boundary of
        a ``fence`` from within.
        """
        points = np.array(path, dtype=np.float64)
        broken = self._contains(points) != (self.role == "fence")
        for start in range(0, len(points) - 1, step := max(1, _MOST_PAIRS // len(self.points))):
            legs = np.stack((points[:-1], points[1:]), axis=1)[start : start + step]
            found = self._circle_breached(legs) if self.radius else self._ring_breached(legs)
            broken[start + 1 : start + 1 + len(legs)] |= found
        return int(broken.argmax()) if broken.any() else None

    def _contains(self, positions: FloatArray) -> NDArray[np.bool_]:
        """Whether each position ``(n, 2)`` is in the area or on its boundary."""
        if self.radius:
            inside: NDArray[np.bool_] = np.linalg.norm(positions - self.points[0], axis=1) <= self.radius
            return inside
        ring = np.array(self.points)
        found = np.empty(len(positions), dtype=np.bool_)
        for start in range(0, len(positions), step := max(1, _MOST_PAIRS // len(ring))):
            some = positions[start : start + step, None]
            (x, y), (x1, y1), (x2, y2) = np.moveaxis(some, -1, 0), ring[:-1].T, ring[1:].T
            spans = (y1 > y) != (y2 > y)
            # An edge that does not span y is level or elsewhere: its quotient is not looked at.
            rise = np.where(spans, y2 - y1, 1.0)
            odd = np.count_nonzero(spans & (x < x1 + (y - y1) * (x2 - x1) / rise), axis=1) % 2 == 1
            found[start : start + step] = odd | (_distances(some, ring[:-1], ring[1:]) <= _TOUCHES).any(axis=1)
        return found

    def _circle_breached(self, legs: FloatArray) -> NDArray[np.bool_]:
        if self.role == "fence":
            # A circle is convex: a leg between two points inside stays inside.
            return np.zeros(len(legs), dtype=np.bool_)
        gap = _distances(np.array(self.points[0]), legs[:, 0], legs[:, 1])
        return np.asarray(gap <= self.radius)

    def _ring_breached(self, legs: FloatArray) -> NDArray[np.bool_]:
        """Whether each leg ``(n, 2, 2)`` between two allowed places breaks the polygon's boundary."""
        ring = np.array(self.points)
        a, b, c, d = legs[:, None, 0], legs[:, None, 1], ring[None, :-1], ring[None, 1:]
        crossed = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        corner = _distances(c, a, b) <= _TOUCHES
        touched = corner | (_distances(a, c, d) <= _TOUCHES) | (_distances(b, c, d) <= _TOUCHES)
        met = (crossed | touched).any(axis=1)
        if self.role == "no_fly":
            return np.asarray(met)
        broken = np.zeros(len(legs), dtype=np.bool_)
        for leg in np.flatnonzero(met):
            broken[leg] = not self._contains(_between(legs[leg], ring, crossed[leg], corner[leg])).all()
        return broken


def _between(leg: FloatArray, ring: FloatArray, crossed: NDArray[np.bool_], corner: NDArray[np.bool_]) -> FloatArray:
    """The middle of each piece of a leg, which the boundary's crossings and corners cut; ``(n, 2)``."""
    (start, end), first, last = leg, ring[:-1][crossed], ring[1:][crossed]
    from_first, from_last = _side(start, end, first), _side(start, end, last)
    cuts = first + (from_first / (from_first - from_last))[:, None] * (last - first)
    way = end - start
    along = (np.concatenate((cuts, ring[:-1][corner])) - start) @ way / max(float(way @ way), 1e-300)
    shares = np.unique(np.clip(np.concatenate(([0.0, 1.0], along)), 0.0, 1.0))
    return np.asarray(start + ((shares[:-1] + shares[1:]) / 2)[:, None] * way)


def _distances(points: FloatArray, starts: FloatArray, ends: FloatArray) -> FloatArray:
    """The distance of each point to a segment; the arrays ``(..., 2)`` are broadcast."""
    way, gap = ends - starts, points - starts
    length = np.sum(way * way, axis=-1)
    along = np.clip(np.sum(gap * way, axis=-1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(gap - along[..., None] * way, axis=-1))


def _side(start: ArrayLike, end: ArrayLike, point: ArrayLike) -> FloatArray:
    """Twice the signed area of a triangle, hence the side of a line on which a point is."""
    a, b, p = (np.asarray(value, dtype=np.float64) for value in (start, end, point))
    (dx, dy), (px, py) = np.moveaxis(b - a, -1, 0), np.moveaxis(p - a, -1, 0)
    return np.asarray(dx * py - dy * px)
