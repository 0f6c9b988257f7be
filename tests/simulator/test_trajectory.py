"""Laps: hand-computed points, direction, and distance flown."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.scenario import SCENARIOS
from simulator.trajectory import Laps


def two_laps() -> Laps:
    return Laps([(0.0, 0.0), (100.0, 50.0)], 10.0, [0.0, np.pi / 2])


def test_uavs_start_at_their_start_angles() -> None:
    np.testing.assert_allclose(two_laps().positions, [(10.0, 0.0), (100.0, 60.0)], atol=1e-12)


def test_a_quarter_lap_goes_counter_clockwise() -> None:
    laps = two_laps()
    got = laps.advance(10.0 * np.pi / 2)
    np.testing.assert_allclose(got, [(0.0, 10.0), (90.0, 50.0)], atol=1e-12)
    np.testing.assert_array_equal(got, laps.positions)


def test_uavs_advance_each_by_its_own_distance() -> None:
    laps = two_laps()
    laps.advance([0.0, 10.0 * np.pi])
    np.testing.assert_allclose(laps.positions, [(10.0, 0.0), (100.0, 40.0)], atol=1e-12)
    np.testing.assert_allclose(laps.travelled_m, [0.0, 10.0 * np.pi])


def test_looking_ahead_is_vectorised_and_moves_nobody() -> None:
    laps = two_laps()
    ahead = laps.at(np.array([0.0, 10.0 * np.pi])[:, None])
    assert ahead.shape == (2, 2, 2)
    np.testing.assert_allclose(ahead[1], [(-10.0, 0.0), (100.0, 40.0)], atol=1e-12)
    np.testing.assert_allclose(laps.positions, [(10.0, 0.0), (100.0, 60.0)], atol=1e-12)


def test_at_an_angle() -> None:
    np.testing.assert_allclose(two_laps().at_angle(np.pi), [(-10.0, 0.0), (90.0, 50.0)], atol=1e-12)


@given(st.lists(st.integers(0, 140), max_size=60), st.integers(0, 2**32))
def test_uavs_never_leave_their_circles(distances: list[int], seed: int) -> None:
    scenario = SCENARIOS["paper"]
    laps = Laps.draw(scenario, np.random.default_rng(seed))
    for distance in distances:
        before = laps.positions
        after = laps.advance(float(distance))
        np.testing.assert_allclose(np.hypot(*(after - laps.centres).T), 300.0)
        np.testing.assert_allclose(np.hypot(*(after - before).T), 600.0 * np.sin(distance / 600.0), atol=1e-6)


@pytest.mark.parametrize("distance", [-1.0, float("nan"), [1.0, float("inf")]])
def test_a_distance_must_be_finite_and_forward(distance: float | list[float]) -> None:
    with pytest.raises(ValueError, match="distance_m"):
        two_laps().advance(distance)


def test_a_circle_needs_a_radius_and_a_centre_for_every_uav() -> None:
    with pytest.raises(ValueError, match="radius_m is 0"):
        Laps([(0.0, 0.0)], 0, [0.0])
    with pytest.raises(ValueError, match="centres have shape"):
        Laps([(0.0, 0.0)], 1.0, [0.0, 1.0])
