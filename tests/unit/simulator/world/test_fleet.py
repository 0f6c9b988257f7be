"""Fleets: starts, and the distance flown along trajectories of either kind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.world.scenario import SCENARIOS
from shared.world.trajectory import Circle, Polyline
from simulator.world.fleet import Fleet


def two() -> Fleet:
    return Fleet([Circle((0.0, 0.0), 10.0), Polyline([(0, 0), (100, 0)])], [0.0, 20.0])


def test_uavs_start_where_they_are_put() -> None:
    np.testing.assert_allclose(two().positions, [(10.0, 0.0), (20.0, 0.0)], atol=1e-12)


def test_uavs_advance_each_by_its_own_distance() -> None:
    fleet = two()
    got = fleet.advance([10.0 * np.pi / 2, 90.0])
    np.testing.assert_allclose(got, [(0.0, 10.0), (90.0, 0.0)], atol=1e-12)
    np.testing.assert_array_equal(got, fleet.positions)


def test_looking_ahead_is_vectorised_and_moves_no_uav() -> None:
    fleet = two()
    ahead = fleet.at(np.array([[0.0, 0.0], [10.0 * np.pi, 50.0]]))
    assert ahead.shape == (2, 2, 2)
    np.testing.assert_allclose(ahead[1], [(-10.0, 0.0), (50.0, 0.0)], atol=1e-12)
    np.testing.assert_allclose(fleet.positions, [(10.0, 0.0), (20.0, 0.0)], atol=1e-12)


@given(st.lists(st.integers(0, 140), max_size=60), st.integers(0, 2**32))
def test_uavs_never_leave_their_circles(distances: list[int], seed: int) -> None:
    scenario = SCENARIOS["paper"]
    fleet = Fleet.draw(scenario, np.random.default_rng(seed))
    for distance in distances:
        before = fleet.positions
        after = fleet.advance(float(distance))
        np.testing.assert_allclose(np.hypot(*(after - scenario.lap_centres).T), 300.0)
        np.testing.assert_allclose(np.hypot(*(after - before).T), 600.0 * np.sin(distance / 600.0), atol=1e-6)


@pytest.mark.parametrize("distance", [-1.0, float("nan"), [1.0, float("inf")]])
def test_a_distance_must_be_finite_and_forward(distance: float | list[float]) -> None:
    with pytest.raises(ValueError, match="distance_m"):
        two().advance(distance)


def test_every_uav_needs_a_start() -> None:
    with pytest.raises(ValueError, match="2 trajectories"):
        Fleet(two().trajectories, [0.0])
