"""The drift: what a UAV flies in a wind, learned from its progress."""

from __future__ import annotations

import math

import numpy as np
import pytest

from shared.belief.drift import Drift
from shared.world.scenario import SCENARIOS
from shared.world.trajectory import Circle, trajectories

LAP = trajectories(SCENARIOS["paper"])[0]


def flown_in(wind: tuple[float, float], start_m: float, still_m: float) -> float:
    """The way in a wind, as the share of its component along the heading in the middle of the way in still air."""
    angle = (start_m + still_m / 2) / 300.0
    return still_m * (1.0 - wind[0] * math.sin(angle) + wind[1] * math.cos(angle))


def learned(wind: tuple[float, float], steps: int = 20) -> Drift:
    drift, progress = Drift(), 100.0
    for _ in range(steps):
        way = flown_in(wind, progress, 140.0)
        drift.learn(LAP, progress, 140.0, progress + way)
        progress += way
    return drift


def test_still_air_is_no_drift_and_changes_no_number() -> None:
    drift, ways = learned((0.0, 0.0)), np.arange(10.0)
    assert drift.none
    assert drift.flown(LAP, 3.0, ways) is ways


def test_the_wind_is_found() -> None:
    assert learned((0.3, -0.2)).wind == pytest.approx((0.3, -0.2), abs=0.05)


def test_the_way_ahead_is_longer_with_the_wind_and_shorter_against_it() -> None:
    drift = learned((0.3, 0.0))
    # The lap begins due east and goes north: west along its north, east along its south.
    quarter = LAP.length_m / 4
    ahead = np.array([0.0, 70.0, 140.0])
    against, along = (drift.flown(LAP, start, ahead) for start in (quarter - 70, 3 * quarter - 70))
    assert against[0] == along[0] == 0
    assert against[2] == pytest.approx(140 * 0.7, rel=0.05)
    assert along[2] == pytest.approx(140 * 1.3, rel=0.05)


def test_impossible_progress_is_bounded() -> None:
    drift = Drift()
    for _ in range(50):
        drift.learn(LAP, 0.0, 140.0, 1e9)
    assert drift.flown(LAP, 0.0, np.array([140.0]))[0] <= 2.2 * 140
    drift.learn(LAP, 0.0, 0.0, 50.0)


def test_a_restored_drift_goes_on_as_it_was() -> None:
    drift, again = learned((0.1, 0.2)), Drift()
    again.load_state_dict(drift.state_dict())
    np.testing.assert_array_equal(drift.wind, again.wind)
    assert isinstance(LAP, Circle)


def test_top_speeds_are_kept_and_a_short_way_of_such_an_airframe_says_nothing_of_the_wind() -> None:
    drift, again = Drift(), Drift()
    assert drift.fastest([0, 1], 14) == 14
    drift.tops = {0: 9, 1: 11}
    assert [drift.fastest(uavs, 14) for uavs in ([0], [0, 1], [1, 2], [])] == [9, 11, 14, 14]
    drift.learn(LAP, 0.0, 10.0, 35.0)
    assert drift.none
    drift.learn(LAP, 0.0, 100.0, 60.0)
    assert not drift.none
    again.load_state_dict(drift.state_dict())
    assert again.tops == {0: 9, 1: 11}
    earlier = drift.state_dict()
    del earlier["tops"]
    again.load_state_dict(earlier)
    assert again.tops == {}


@pytest.mark.parametrize("start_m", [500.0, 0.1, LAP.length_m - 0.1])
@pytest.mark.parametrize("shaken_m", [-0.2, 0.2])
def test_a_uav_that_hovers_is_blown_nowhere_by_the_noise_of_its_place(start_m: float, shaken_m: float) -> None:
    """Backwards by centimetres is no lap, and forwards over the end of a lap no lap backwards."""
    stays = Drift()
    stays.learn(LAP, start_m, 50.0, (start_m + shaken_m) % LAP.length_m)
    ways = np.array([0.0, 140.0])
    assert stays.flown(LAP, start_m, ways)[1] < 140.0


def test_a_way_of_a_whole_flight_is_as_the_sum_of_its_parts() -> None:
    drift, end, whole = learned((0.2, 0.1)), 100.0, 60_000.0
    for _ in range(60):
        end += float(drift.flown(LAP, end, np.array([whole / 60]))[0])
    assert float(drift.flown(LAP, 100.0, np.array([whole]))[0]) == pytest.approx(end - 100.0, rel=0.01)


@pytest.mark.parametrize("laps", [0.3, 1.0, 2.3, 5.0])
def test_still_air_is_no_wind_however_many_laps_a_step_has(laps: float) -> None:
    drift, way = Drift(), laps * LAP.length_m
    for step in range(10):
        drift.learn(LAP, step * way % LAP.length_m, way, (step + 1) * way % LAP.length_m)
    assert drift.none
