"""The radio map: what it predicts where, how sure it is, and how far a lie moves it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from shared.belief.radio_map import LARGEST_EXCESS_DB, RadioMap
from shared.world.channel import FloatArray

PLACES = np.array([[100.0 * i, 50.0 * (i % 3)] for i in range(12)])
ALL = np.arange(10)


def mapped(excess: FloatArray, sensors: int = 10) -> RadioMap:
    """A map of the measured excess losses ``(12, n)``, dB, at the places."""
    found = RadioMap(sensors)
    for place, row in zip(PLACES, excess, strict=True):
        found.measure(np.arange(len(row)), place, row)
    return found


def test_a_world_that_equals_the_formula_leaves_no_doubt() -> None:
    found = mapped(np.full((12, 10), 1e-7))
    mean, deviation = found.predict(np.array([[3.0, 4.0]]), ALL)
    assert found.exact
    assert not mean.any() and not deviation.any()


def test_before_the_first_beacon_any_link_may_differ() -> None:
    mean, deviation = RadioMap(3).predict(np.zeros((2, 2)), np.arange(3))
    assert mean.tolist() == [[0.0] * 3] * 2
    assert (deviation > 3).all()


def test_a_sensors_own_excess_is_expected_at_places_where_it_was_never_heard() -> None:
    own = np.linspace(-12.0, 12.0, 10)
    found = mapped(np.tile(own, (12, 1)))
    mean, deviation = found.predict(np.array([[5000.0, 5000.0]]), ALL)
    np.testing.assert_allclose(mean[0], own, atol=0.7)
    assert (deviation < 1.0).all()


def test_a_sensor_never_heard_is_as_uncertain_as_the_sensors_differ() -> None:
    found = mapped(np.tile(np.linspace(-12.0, 12.0, 9), (12, 1)) + np.random.default_rng(0).normal(0, 2, (12, 9)))
    mean, deviation = found.predict(np.zeros((1, 2)), np.array([9]))
    assert abs(mean[0, 0]) < 3
    assert 4 < deviation[0, 0] < 12


def test_an_offset_of_all_links_is_expected_of_a_sensor_never_heard_too() -> None:
    found = mapped(6.0 + np.random.default_rng(1).normal(0, 1, (12, 9)))
    assert found.predict(np.zeros((1, 2)), np.array([9]))[0][0, 0] == pytest.approx(6.0, abs=1.5)


def test_the_excess_of_a_place_is_expected_near_it_and_not_far_from_it() -> None:
    by_place = np.random.default_rng(2).normal(0, 8, (12, 10))
    found = mapped(by_place)
    # One visit cannot tell a place from fading: the second lap comes by 3 m beside.
    for place, row in zip(PLACES, by_place, strict=True):
        found.measure(ALL, place + 3.0, row + 0.5)
    near, _ = found.predict(PLACES[5:6] + 2.0, ALL)
    far, unsure = found.predict(np.array([[9000.0, 0.0]]), ALL)
    assert np.abs(near[0] - by_place[5]).mean() < np.abs(far[0] - by_place[5]).mean() / 2
    assert (unsure > 5).all()


def test_fading_is_no_map_and_stays_uncertain_at_the_very_place() -> None:
    random = np.random.default_rng(3)
    found = RadioMap(10)
    for _ in range(4):
        for place in PLACES:
            found.measure(ALL, place, random.normal(0, 5, 10))
    mean, deviation = found.predict(PLACES, ALL)
    assert np.sqrt(np.square(mean).mean()) < 2.5
    assert (np.abs(deviation - 5) < 1.5).all()


def test_a_lie_is_bounded_and_one_of_many_reports_hardly_counts() -> None:
    random = np.random.default_rng(4)
    honest, lied = RadioMap(10), RadioMap(10)
    for found in (honest, lied):
        for place in PLACES:
            found.measure(ALL, place, np.round(random.normal(0, 2, 10), 3))
    random = np.random.default_rng(4)
    lied.measure(np.array([0]), np.array([550.0, 20.0]), np.array([1e6]))
    elsewhere = np.array([[550.0, 400.0]])
    before, after = (found.predict(elsewhere, ALL)[0][0, 0] for found in (honest, lied))
    assert abs(after - before) < 3
    for place in PLACES:
        for _ in range(10):
            lied.measure(np.array([0]), place, np.array([-1e6]))
    assert (np.abs(lied.predict(PLACES, ALL)[0]) <= LARGEST_EXCESS_DB + 1).all()


def test_two_measurements_of_a_place_are_kept_the_newest() -> None:
    found = RadioMap(10)
    for lap in range(4):
        for place in PLACES:
            found.measure(ALL, place + lap, np.full(10, 3.0 + lap))
    assert found.count.tolist() == [2 * len(PLACES)] * 10
    kept = np.sort(found.excess[0, : found.count[0]])
    assert kept.tolist() == [5.0] * len(PLACES) + [6.0] * len(PLACES)


def test_a_full_record_keeps_the_newest_measurement_of_a_place() -> None:
    found = RadioMap(10)
    places = np.array([[40.0 * number, 0.0] for number in range(30)])
    for lap in range(4):
        for place in places:
            found.measure(ALL, place, np.full(10, 3.0 + lap))
    assert found.count.max() == found.excess.shape[1] < 60
    assert found.predict(places[:1], ALL)[0][0] == pytest.approx([6.0] * 10, abs=1.5)


def test_a_record_of_places_never_measured_twice_drops_the_nearest() -> None:
    found = RadioMap(1)
    kept = found.excess.shape[1]
    for number in range(kept):
        found.measure(np.array([0]), np.array([100.0 * number, 0.0]), np.array([float(number)]))
    found.measure(np.array([0]), np.array([330.0, 0.0]), np.array([33.0]))
    assert found.count[0] == kept
    assert set(range(kept)) - set(found.excess[0].tolist()) == {3} and 33.0 in found.excess[0]


@pytest.mark.parametrize("sensors", [1, 10, 1000, 10_000])
def test_a_map_of_many_sensors_keeps_less_of_each(sensors: int) -> None:
    found = RadioMap(sensors)
    assert found.excess.shape[1] >= 1 and found.excess.size <= max(4096, sensors)
    found.measure(np.arange(min(sensors, 400)), np.zeros(2), np.full(min(sensors, 400), 4.0))
    assert found.predict(np.zeros((1, 2)), np.array([0]))[0][0, 0] > 1.0


def test_a_restored_map_predicts_the_same_to_the_bit() -> None:
    found = mapped(np.random.default_rng(5).normal(0, 6, (12, 10)))
    again = RadioMap(10)
    again.load_state_dict(found.state_dict())
    for one in (found, again):
        one.measure(np.array([2, 3]), np.array([7.0, 8.0]), np.array([1.0, -2.0]))
    for ours, theirs in zip(found.predict(PLACES, ALL), again.predict(PLACES, ALL), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_report_without_a_fresh_beacon_changes_nothing() -> None:
    found = RadioMap(3)
    found.measure(np.array([], dtype=np.int64), np.zeros(2), np.array([]))
    assert found.heard == 0


@pytest.mark.parametrize("seed", range(5))
def test_a_restored_map_is_the_same_to_the_bit_however_often_each_sensor_was_heard(seed: int) -> None:
    random = np.random.default_rng(seed)
    found = RadioMap(10)
    for _ in range(50):
        ids = np.sort(random.choice(10, random.integers(1, 7), replace=False))
        found.measure(ids, random.uniform(0, 1000, 2), random.normal(0, 8, len(ids)))
    again = RadioMap(10)
    again.load_state_dict(found.state_dict())
    assert again.offset_db == found.offset_db and again.deviation_db == found.deviation_db
    for ours, theirs in zip(found.predict(PLACES, ALL), again.predict(PLACES, ALL), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("seed", range(5))
def test_changing_the_inverses_by_a_row_gives_what_inverting_them_anew_gives(seed: int) -> None:
    random = np.random.default_rng(seed)
    found = RadioMap(10)
    for number in range(200):
        ids = np.sort(random.choice(10, random.integers(1, 11), replace=False))
        found.measure(ids, random.uniform(0, 1000, 2), random.normal(0, 8, len(ids)))
        if number % 20:
            continue
        anew = RadioMap(10)
        anew.load_state_dict({**found.state_dict(), "solved": None})
        for ours, theirs in zip(found.predict(PLACES, ALL), anew.predict(PLACES, ALL), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)


AROUND = np.array([[math.cos(angle), math.sin(angle)] for angle in np.linspace(0, 2 * math.pi, 12, False)]) * 300.0
EVERYWHERE = np.stack(np.meshgrid(np.linspace(-400, 400, 9), np.linspace(-400, 400, 9)), axis=-1).reshape(-1, 2)


def flown(deviation_db: float, seed: int) -> RadioMap:
    """A map after an honest lap, half of the excess losses' variance the sensors' own."""
    random, found = np.random.default_rng(seed), RadioMap(10)
    own, along = random.normal(0, deviation_db * 0.7, 10), random.normal(0, deviation_db * 0.7, (12, 10))
    for place, row in zip(AROUND, along, strict=True):
        found.measure(ALL, place, own + row)
    return found


@pytest.mark.parametrize("deviation_db", [0.0, 4.0, 8.0])
@pytest.mark.parametrize("lie_db", [1e6, -1e6, 20.0, 5.0])
def test_a_forged_report_moves_no_link_much_further_than_the_links_differ(deviation_db: float, lie_db: float) -> None:
    for seed in range(20):
        found = flown(deviation_db, seed)
        before = found.predict(EVERYWHERE, ALL)[0]
        found.measure(ALL, AROUND[3] + 7.0, np.full(10, lie_db))
        assert np.abs(found.predict(EVERYWHERE, ALL)[0] - before).max() <= max(1.6 * deviation_db, 0.5)


def test_any_number_of_lies_is_bounded_and_honest_laps_undo_them() -> None:
    found = flown(4.0, 0)
    before = found.predict(AROUND, ALL)[0]
    for lie in range(100):
        found.measure(ALL, AROUND[lie % 12] + 3.0, np.full(10, 1e6))
    assert np.abs(found.predict(EVERYWHERE, ALL)[0]).max() <= LARGEST_EXCESS_DB
    lied = np.abs(found.predict(AROUND, ALL)[0] - before).max()
    for _ in range(3):
        for place, row in zip(AROUND, before, strict=True):
            found.measure(ALL, place, row)
    undone = np.abs(found.predict(AROUND, ALL)[0] - before).max()
    assert lied > 15.0 > 5.0 > undone
