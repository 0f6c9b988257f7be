"""Fleets: starts, and the distance flown along trajectories of either kind."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shared.world.scenario import SCENARIOS
from shared.world.trajectory import Circle, Polyline
from simulator.world.batch import Fleet


def two() -> Fleet:
    start_m = np.array([0.0, 20.0])
    return Fleet((Circle((0.0, 0.0), 10.0), Polyline([(0, 0), (100, 0)])), start_m, start_m)


def test_uavs_start_where_they_are_put() -> None:
    np.testing.assert_allclose(two().positions, [(10.0, 0.0), (20.0, 0.0)], atol=1e-12)


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
    flown = np.cumsum([0, *distances])[:, None] + fleet.start_m
    places = fleet.at(flown)
    np.testing.assert_allclose(np.hypot(*(places - scenario.lap_centres).transpose(2, 0, 1)), 300.0)
    chords = np.hypot(*np.diff(places, axis=0).transpose(2, 0, 1))
    expected = 600.0 * np.sin(np.array(distances, dtype=float) / 600.0)
    np.testing.assert_allclose(chords, np.broadcast_to(expected[:, None], chords.shape), atol=1e-6)
