"""Trajectories: hand-computed points, direction, and the way back from a position to how far along it lies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.world.scenario import SCENARIOS, Scenario
from shared.world.trajectory import Circle, Polyline, Trajectory, progress_of, trajectories

SQUARE = Polyline([(0, 0), (100, 0), (100, 100), (0, 100), (0, 0)])
THERE_AND_BACK = Polyline([(0, 0), (100, 0), (100, 50)])
CIRCLE = Circle((100.0, 50.0), 10.0)


def test_a_circle_begins_due_east_and_goes_counter_clockwise() -> None:
    quarter = 10.0 * np.pi / 2
    expected = [(110.0, 50.0), (100.0, 60.0), (90.0, 50.0), (110.0, 50.0)]
    np.testing.assert_allclose(CIRCLE.at([0.0, quarter, 2 * quarter, 4 * quarter]), expected, atol=1e-12)
    assert CIRCLE.length_m == pytest.approx(4 * quarter)


def test_a_closed_route_is_flown_round() -> None:
    assert SQUARE.length_m == 400.0
    np.testing.assert_allclose(
        SQUARE.at([0, 50, 150, 250, 350, 450]), [(0, 0), (50, 0), (100, 50), (50, 100), (0, 50), (50, 0)]
    )


def test_an_open_route_is_flown_there_and_back() -> None:
    assert THERE_AND_BACK.length_m == 300.0
    np.testing.assert_allclose(
        THERE_AND_BACK.at([120, 150, 180, 290, 310]), [(100, 20), (100, 50), (100, 20), (10, 0), (10, 0)]
    )


def test_waypoints_said_twice_are_one() -> None:
    twice = Polyline([(0, 0), (0, 0), (100, 0), (100, 0), (100, 50)])
    np.testing.assert_array_equal(twice.at([10.0, 120.0]), THERE_AND_BACK.at([10.0, 120.0]))


def test_bounds_hold_every_point() -> None:
    for path in (CIRCLE, SQUARE, THERE_AND_BACK):
        low, high = path.bounds
        points = path.at(np.linspace(0, path.length_m, 999))
        assert np.all(points >= low - 1e-9)
        assert np.all(points <= high + 1e-9)


def test_shapes_are_kept() -> None:
    for path in (CIRCLE, SQUARE):
        assert path.at(3.0).shape == (2,)
        assert path.at(np.zeros((4, 5))).shape == (4, 5, 2)


@pytest.mark.parametrize("path", [CIRCLE, SQUARE])
@given(flown=st.floats(0, 2000))
def test_a_position_tells_how_far_along_it_lies(path: Trajectory, flown: float) -> None:
    x, y = path.at(flown)
    progress, gap = path.locate((float(x), float(y)))
    assert gap == pytest.approx(0.0, abs=1e-6)
    off = (progress - flown) % path.length_m
    assert min(off, path.length_m - off) == pytest.approx(0.0, abs=1e-6)


def test_the_gap_is_the_way_to_the_trajectory() -> None:
    assert SQUARE.locate((50.0, -7.0)) == pytest.approx((50.0, 7.0))
    assert CIRCLE.locate((100.0, 53.0))[1] == pytest.approx(7.0)


def test_there_and_back_only_the_uav_knows_which() -> None:
    there, back = 40.0, 260.0
    assert progress_of(THERE_AND_BACK, (40.0, 0.0)) == there
    assert progress_of(THERE_AND_BACK, (40.0, 0.0), reported_m=back) == back
    assert progress_of(THERE_AND_BACK, (40.0, 0.0), reported_m=120.0) == there  # it is not there


def test_off_its_trajectory() -> None:
    assert progress_of(SQUARE, (50.0, 30.0)) is None
    assert progress_of(SQUARE, (50.0, 30.0), reported_m=50.0) is None
    assert progress_of(SQUARE, (50.0, 9.0)) == 50.0


def test_a_scenario_has_circles_unless_it_has_routes() -> None:
    paper = SCENARIOS["paper"]
    for path, centre in zip(trajectories(paper), paper.lap_centres, strict=True):
        assert math.dist(path.at(123.0), centre) == pytest.approx(300.0)
    routed = Scenario(uavs=1, routes=(((0.0, 0.0), (100.0, 0.0), (100.0, 50.0)),))
    np.testing.assert_array_equal(trajectories(routed)[0].at(120.0), (100.0, 20.0))


def test_what_is_no_trajectory() -> None:
    with pytest.raises(ValueError, match="two different waypoints"):
        Polyline([(1, 1), (1, 1)])
