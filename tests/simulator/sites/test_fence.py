"""Fences: which positions and ways they allow."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.world_folder import site_from_folder
from tests.simulator.sites.files.made_folder import GOOD, feature, write

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


def test_a_circle_is_not_left() -> None:
    circle = Fence("fence", ((5.0, 5.0),), 2.0)
    assert circle.first_breach([(4, 4), (6, 6)]) is None and circle.first_breach([(4, 4), (7, 7)]) == 1


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
