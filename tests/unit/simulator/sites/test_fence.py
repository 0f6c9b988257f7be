"""Fences: which positions and ways they allow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.world.scenario import Point
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.world_folder import site_from_folder
from tests.support.world_folders import GOOD, feature, write

# An L: its inner corner is at 5, 5.
BENT = ((0.0, 0.0), (10.0, 0.0), (10.0, 5.0), (5.0, 5.0), (5.0, 10.0), (0.0, 10.0), (0.0, 0.0))


def test_a_polygon_is_not_left_even_between_two_places_inside() -> None:
    fence = Fence("fence", BENT)
    assert fence.allows((1, 9)) and fence.allows((9, 1)) and not fence.allows((9, 9))
    assert fence.first_breach([(1, 1), (9, 1), (1, 1), (1, 9)]) is None
    assert fence.first_breach([(9, 1), (1, 1), (9, 4), (4, 9)]) == 3, "across the inner corner"
    assert fence.first_breach([(1, 1), (11, 1)]) == 1 and fence.first_breach([(-1, 1), (1, 1)]) == 0


def test_an_area_is_not_entered() -> None:
    square = Fence("no_fly", ((4.0, 4.0), (6.0, 4.0), (6.0, 6.0), (4.0, 6.0), (4.0, 4.0)))
    assert square.first_breach([(0, 0), (9, 0), (9, 9)]) is None
    assert square.first_breach([(0, 0), (0, 5), (9, 5)]) == 2
    circle = Fence("no_fly", ((5.0, 5.0),), 2.0)
    assert circle.first_breach([(0, 2), (9, 2)]) is None
    assert circle.first_breach([(0, 4), (9, 4)]) == 1 and circle.first_breach([(5, 6), (9, 9)]) == 0


OCTAGON = ((3, 0), (6, 0), (9, 3), (9, 6), (6, 9), (3, 9), (0, 6), (0, 3), (3, 0))


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ([(-1, -1), (10, 10)], "across two edges"),
        ([(0, -3), (9, 15)], "through two corners: y = 2 x - 3"),
        ([(3, -2), (3, 11)], "through two corners, upright"),
        ([(-2, 3), (11, 3)], "through two corners, level"),
        ([(9, -3), (9, 12)], "along an edge"),
        ([(-3, 6), (3, 12), (9, 6)], "to a corner"),
        ([(12, 3), (9, 6), (12, 9)], "a corner alone"),
    ],
)
def test_an_area_is_not_entered_through_its_corners(path: list[Point], why: str) -> None:
    area = Fence("no_fly", OCTAGON)
    assert area.first_breach(path) is not None, why
    assert area.first_breach(path[::-1]) is not None, why


def test_a_fence_is_not_left_through_its_corners() -> None:
    # A notch, whose corners are on one line with a leg.
    notched = Fence("fence", ((0, 0), (9, 0), (9, 6), (6, 6), (5, 2), (4, 6), (0, 6), (0, 0)))
    assert notched.first_breach([(1, 6), (8, 6)]) == 1 and notched.first_breach([(1, 2), (8, 2)]) is None
    assert notched.first_breach([(0, 0), (9, 0), (9, 6), (6, 6), (5, 2)]) is None, "along the boundary"


CORNERS = st.tuples(st.integers(0, 6), st.integers(0, 6))


def _within(point: tuple[Fraction, Fraction], ring: Sequence[tuple[int, int]]) -> bool | None:
    """Whether the point is inside, by exact arithmetic; None on the boundary."""
    inside, (x, y) = False, point
    for (x1, y1), (x2, y2) in pairwise(ring):
        side = (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)
        if side == 0 and min(x1, x2) <= x <= max(x1, x2) and min(y1, y2) <= y <= max(y1, y2):
            return None
        if (y1 > y) != (y2 > y) and (side > 0) == (y2 > y1):
            inside = not inside
    return inside


@given(centre=CORNERS, angles=st.lists(CORNERS, min_size=3, max_size=7, unique=True), ends=st.tuples(CORNERS, CORNERS))
def test_no_leg_passes_a_boundary_unseen(
    centre: tuple[int, int], angles: list[tuple[int, int]], ends: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    """Corners and ends on a grid, so that legs often meet corners and edges; 97 places of each leg by exact numbers."""
    ring = sorted(angles, key=lambda c: (math.atan2(c[1] - centre[1] - 0.3, c[0] - centre[0] - 0.2), c))
    ring = [*ring, ring[0]]
    (x1, y1), (x2, y2) = ends
    shares = [Fraction(i, 96) for i in range(97)]
    places = {_within((x1 + s * (x2 - x1), y1 + s * (y2 - y1)), ring) for s in shares}
    points = tuple((float(x), float(y)) for x, y in ring)
    if False in places:
        assert Fence("fence", points).first_breach(ends) is not None
    if places != {False}:
        assert Fence("no_fly", points).first_breach(ends) is not None


def test_a_circle_is_not_left() -> None:
    circle = Fence("fence", ((5.0, 5.0),), 2.0)
    assert circle.first_breach([(4, 4), (6, 6)]) is None and circle.first_breach([(4, 4), (7, 7)]) == 1


def test_a_circles_boundary_belongs_to_its_area() -> None:
    fence, area = (Fence(role, ((5.0, 5.0),), 2.0) for role in ("fence", "no_fly"))
    assert fence.allows((7.0, 5.0)) and not fence.allows((7.1, 5.0))
    assert not area.allows((7.0, 5.0)) and area.allows((7.1, 5.0))
    assert area.first_breach([(0.0, 3.0), (9.0, 3.0)]) == 1, "it touches the circle from outside"


RING = [[41.49, 39.94], [41.52, 39.94], [41.52, 39.97], [41.49, 39.97], [41.49, 39.94]]


def test_a_world_has_its_fences_in_metres(tmp_path: Path) -> None:
    no_fly = feature("no_fly", "Point", [41.49, 39.96], radius_m=100.0)
    site = site_from_folder(write(tmp_path, *GOOD, feature("fence", "Polygon", [RING]), no_fly))
    fence, circle = site.fences
    assert fence.allows(site.scenario.sites[0]) and circle.allows(site.scenario.sites[0])
    assert site.frame is not None
    for longitude, latitude in RING:
        [[x, y]] = site.frame.metres([[longitude, latitude]]).tolist()
        assert fence.points[RING.index([longitude, latitude])] == pytest.approx((x, y))
        assert site.frame.degrees([[x, y]])[0] == pytest.approx((longitude, latitude), abs=1e-9)
    assert site.frame.metres([[41.5, 39.95]])[0] == pytest.approx(site.scenario.sites[0], abs=0.002)


@pytest.mark.parametrize(
    ("drawn", "names"),
    [
        (
            feature("fence", "Polygon", [[[41.5, 39.9], [41.505, 39.9], [41.505, 39.96], [41.5, 39.9]]]),
            "leaves the fen",
        ),
        (feature("no_fly", "Point", [41.505, 39.952], radius_m=300.0), "enters the no_fly area"),
        (feature("fence", "LineString", [[41.5, 39.95], [41.51, 39.955]]), "a fence is a Polygon, or a Point with"),
        (feature("no_fly", "Point", [41.505, 39.952]), "a no_fly is a Polygon, or a Point with the property radius_m"),
    ],
)
def test_a_fence_that_cannot_hold_is_refused(tmp_path: Path, drawn: dict[str, object], names: str) -> None:
    with pytest.raises(UsageError, match=names):
        site_from_folder(write(tmp_path, *GOOD, drawn))
