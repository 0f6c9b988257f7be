"""What a fleet knows together: the newest beacons, rolled forward, and where the UAVs are."""

from __future__ import annotations

import numpy as np
import pytest

from shared.belief.fleet_belief import FleetBelief
from shared.world.scenario import Scenario

TWO = Scenario(name="two", sensors=2, uavs=2)


def belief() -> FleetBelief:
    return FleetBelief(TWO)


def hear(fleet: FleetBelief, queue: list[float], beacon: list[int]) -> None:
    count = len(queue)
    fleet.hear(np.arange(count), np.zeros((count, 2)), np.array(beacon), np.array(queue), np.full(count, 40.0))


def test_a_sensor_never_heard_began_like_the_average_one() -> None:
    fleet = belief()
    np.testing.assert_allclose(fleet.queue(0), 39.0)
    np.testing.assert_allclose(fleet.queue(2), 49.0)
    assert (fleet.base_variance > 0).all()


def test_the_newest_beacon_wins_whoever_heard_it() -> None:
    fleet = belief()
    hear(fleet, [10.0, 20.0], [4, 2])
    hear(fleet, [55.0, 30.0], [1, 3])
    np.testing.assert_allclose(fleet.base, [10.0, 30.0])
    assert fleet.heard.tolist() == [4, 3]
    assert (fleet.base_variance == 0).all()


def test_a_queue_is_rolled_forward_until_it_is_full() -> None:
    fleet = belief()
    hear(fleet, [10.0, 58.0], [0, 0])
    np.testing.assert_allclose(fleet.queue(3), [25.0, 60.0])


def test_the_rate_is_learned_from_successive_beacons() -> None:
    fleet = belief()
    for now in range(10):
        hear(fleet, [8.0 * now % 60, 2.0 * now], [now, now])
    assert fleet.arrivals.rate[0] > 6.5
    assert fleet.arrivals.rate[1] < 3.0


def test_a_full_queue_says_nothing_of_the_rate() -> None:
    fleet = belief()
    hear(fleet, [50.0, 50.0], [0, 0])
    hear(fleet, [60.0, 55.0], [8, 8])
    assert fleet.arrivals.rate[0] == pytest.approx(5.0)
    assert fleet.arrivals.rate[1] < 5.0


def test_what_was_collected_is_subtracted_and_no_arrival() -> None:
    fleet = belief()
    hear(fleet, [50.0, 50.0], [0, 0])
    fleet.collect(0, 60, step=0)
    assert fleet.queue(1)[0] == pytest.approx(5.0)
    hear(fleet, [9.0, 50.0], [1, 0])
    assert fleet.arrivals.rate[0] > 5.0


def test_a_report_may_name_some_sensors_only() -> None:
    fleet = belief()
    fleet.hear(np.array([1]), np.array([[3.0, 4.0]]), np.array([2]), np.array([7.0]), np.array([1.0]))
    assert fleet.heard.tolist() == [-1, 2]
    assert fleet.base[1] == 7.0
    assert np.isnan(fleet.places[0]).all()


def start(fleet: FleetBelief, uav: int) -> tuple[float, float]:
    x, y = fleet.trajectory(uav).at(0.0)
    return float(x), float(y)


def test_a_uav_has_flown_what_it_was_told() -> None:
    fleet = belief()
    fleet.locate(0, 3, start(fleet, 0), 0.0)
    fleet.record_decision(0, 3, sensor=1, velocity=7)
    fleet.advance(4)
    assert fleet.uavs[0].progress_m == pytest.approx(70.0)
    assert fleet.uavs[0].step == 4
    assert fleet.decided(4) == {}


def test_what_a_uav_was_told_to_collect_is_gone_a_step_later() -> None:
    fleet = belief()
    fleet.hear(np.arange(2), np.array([start(fleet, 0)] * 2), np.zeros(2, np.int64), np.full(2, 50.0), np.ones(2))
    fleet.locate(0, 0, start(fleet, 0), 0.0)
    fleet.record_decision(0, 0, sensor=1, velocity=0)
    assert fleet.queue(0).tolist() == [50.0, 50.0]
    fleet.advance(1)
    np.testing.assert_allclose(fleet.queue(1), [55.0, 5.0])


@pytest.mark.parametrize("sensor", [0, 1])
def test_nothing_is_collected_of_a_sensor_out_of_reach_or_that_nobody_has_named(sensor: int) -> None:
    fleet = belief()
    fleet.hear(np.array([0]), np.array([[1e5, 0.0]]), np.array([3]), np.array([50.0]), np.array([40.0]))
    before = fleet.base.copy()
    fleet.locate(0, 3, (1.0, 0.0))
    fleet.record_decision(0, 3, sensor, 5)
    fleet.advance(4)
    np.testing.assert_array_equal(fleet.base, before)
    assert fleet.visited.tolist() == [-1, -1]


def test_two_uavs_at_one_sensor_collect_from_it_once() -> None:
    world = TWO.model_copy(update={"link_share": 0.35})
    lefts = []
    for uavs in (1, 2):
        fleet = FleetBelief(world)
        fleet.hear(np.arange(2), np.array([start(fleet, 0)] * 2), np.zeros(2, np.int64), np.full(2, 60.0), np.ones(2))
        for uav in range(uavs):
            fleet.uavs.pop(uav, None)
            fleet.locate(uav, 0, start(fleet, 0))
            fleet.record_decision(uav, 0, sensor=1, velocity=0)
        fleet.advance(1)
        lefts.append(float(fleet.queue(1)[1]))
    assert lefts[0] == lefts[1] > 5.0


def test_a_uav_off_its_trajectory_is_taken_to_stay() -> None:
    fleet = belief()
    fleet.locate(0, 0, (1.0, 1.0))
    fleet.record_decision(0, 0, sensor=0, velocity=14)
    fleet.advance(1)
    assert fleet.uavs[0].position == (1.0, 1.0)
    assert fleet.uavs[0].progress_m is None


def test_a_silent_uav_is_no_longer_present() -> None:
    fleet = belief()
    for uav in (0, 1):
        fleet.locate(uav, 0, start(fleet, uav), 0.0)
    fleet.locate(0, 2, start(fleet, 0), 0.0)
    assert fleet.present(2) == [0]


def test_a_uav_asked_again_is_not_held_to_what_it_was_told() -> None:
    fleet = belief()
    fleet.locate(0, 0, start(fleet, 0), 0.0)
    fleet.record_decision(0, 0, sensor=1, velocity=3)
    fleet.locate(0, 0, start(fleet, 0), 0.0)
    assert fleet.decided(0) == {}


@pytest.mark.parametrize("most", [0.0, 5e-324, 1e-300])
def test_a_world_in_which_nothing_arrives_is_known_to_be_one(most: float) -> None:
    fleet = FleetBelief(Scenario(name="idle", sensors=2, uavs=2, arrival_rate_min=0.0, arrival_rate_max=most))
    hear(fleet, [10.0, 58.0], [0, 0])
    np.testing.assert_allclose(fleet.arrivals.rate, 0.0, atol=1e-12)
    np.testing.assert_allclose(fleet.queue(1_000_000), [10.0, 58.0])
    assert np.isfinite(np.random.default_rng(0).gamma(fleet.arrivals.arrived, 1.0 / fleet.arrivals.watched)).all()


def test_an_unheard_queue_is_known_after_a_visit_unless_that_failed() -> None:
    fleet = FleetBelief(Scenario(name="one", sensors=1, uavs=1))
    here = fleet.trajectory(0).at(0.0).tolist()
    fleet.places[0] = here
    fleet.locate(0, 0, here, 0.0)
    fleet.record_decision(0, 0, 0, 0)
    fleet.advance(1)
    assert fleet.visited[0] == 0 and fleet.base_variance[0] == 0
    fleet.settle(0, 0, failed=True)
    assert fleet.visited[0] == -1 and fleet.base_variance[0] > 0


@pytest.mark.parametrize("beacon", [3, 4, 5])
def test_a_beacon_from_before_a_visit_does_not_undo_it(beacon: int) -> None:
    fleet = belief()
    here = fleet.trajectory(0).at(0.0).tolist()
    fleet.hear(np.array([0]), np.array([here]), np.array([2]), np.array([40.0]), np.array([40.0]))
    fleet.locate(0, 5, here, 0.0)
    fleet.record_decision(0, 5, 0, 0)
    fleet.advance(6)
    after = fleet.queue(6)[0]
    fleet.hear(np.array([0]), np.array([here]), np.array([beacon]), np.array([50.0]), np.array([40.0]))
    assert fleet.queue(6)[0] == after < 10
    fleet.hear(np.array([0]), np.array([here]), np.array([6]), np.array([50.0]), np.array([40.0]))
    assert fleet.queue(6)[0] == 50
