"""What a fleet learns of reports beside the queues: outcomes, positions, dead radios, the rate share, the wind."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from shared.belief.fleet_belief import FleetBelief
from shared.world.channel import channel_gain_db
from shared.world.scenario import Scenario

WORLD = Scenario(name="three", sensors=3, uavs=3)
# Metres east of the UAV's place: at hand, too far for a link, far away.
OFF = np.array([40.0, 355.0, 2000.0])
IDS = np.arange(3)


def start(fleet: FleetBelief, uav: int = 0, progress_m: float = 0.0) -> tuple[float, float]:
    x, y = fleet.trajectory(uav).at(progress_m)
    return float(x), float(y)


def report(fleet: FleetBelief, step: int, uav: int = 0, *, queue: float = 50.0, **changes: Any) -> None:
    """A UAV that hovers at the beginning of its lap, hears the sensors, and measures the formula's gains."""
    reported = {"battery": 40.0, "excess_db": np.zeros(3), "heard": IDS, **changes}
    here = start(fleet)
    fleet.advance(step)
    fleet.locate(uav, step, here, 0.0 if uav == 0 else None)
    places = np.array([(here[0] + off, here[1]) for off in OFF])
    heard = reported["heard"]
    beacons = np.full(len(heard), step)
    fleet.hear(heard, places[heard], beacons, np.full(len(heard), queue), np.full(len(heard), reported["battery"]))
    fleet.measure(uav, heard, (channel_gain_db(OFF, WORLD) - reported["excess_db"])[heard])


def visited(sensor: int = 0, **reported: Any) -> FleetBelief:
    """A fleet whose UAV 0 is told in step 0 to visit a sensor, hovering."""
    fleet = FleetBelief(WORLD)
    report(fleet, 0, **reported)
    fleet.record_decision(0, 0, sensor, 0)
    return fleet


# ---- outcomes


def test_a_failed_visit_collects_nothing() -> None:
    fleet = visited()
    fleet.settle(0, 0, failed=True)
    fleet.advance(1)
    assert fleet.queue(1)[0] == pytest.approx(55.0)
    assert fleet.visited[0] == -1


def test_a_failure_that_is_told_late_gives_the_packets_back() -> None:
    fleet = visited()
    fleet.advance(1)
    assert fleet.queue(1)[0] == pytest.approx(5.0)
    report(fleet, 1, uav=1, heard=IDS[1:])
    fleet.settle(0, 0, failed=True)
    assert fleet.queue(1)[0] == pytest.approx(55.0)
    assert (fleet.visited[0], fleet.since[0]) == (-1, 0)


def test_a_failure_that_is_told_after_a_newer_beacon_changes_nothing() -> None:
    fleet = visited()
    report(fleet, 1, uav=1, queue=7.0)
    fleet.settle(0, 0, failed=True)
    assert fleet.queue(1)[0] == 7.0


def test_the_packets_of_a_failed_visit_do_not_come_back_if_another_uav_has_them() -> None:
    fleet = visited()
    report(fleet, 1, uav=1, heard=IDS[1:])
    fleet.record_decision(1, 1, 0, 0)
    fleet.advance(2)
    fleet.settle(0, 0, failed=True)
    assert fleet.queue(2)[0] == pytest.approx(5.0)
    assert fleet.visited[0] == 1


@pytest.mark.parametrize("late", [False, True])
def test_a_success_that_nobody_expected_collects(late: bool) -> None:
    fleet = FleetBelief(WORLD)
    for step in range(3):
        report(fleet, step, excess_db=np.array([40.0, 0.0, 0.0]))
    fleet.record_decision(0, 2, 0, 0)
    if late:
        report(fleet, 3, uav=1, heard=IDS[1:])
        assert fleet.queue(3)[0] > 50.0
    fleet.settle(0, 2, failed=False)
    fleet.advance(3)
    assert fleet.queue(3)[0] < 30.0
    assert fleet.visited[0] == 2


def test_only_the_outcome_of_the_last_decision_counts_and_only_once() -> None:
    fleet = visited()
    report(fleet, 1)
    fleet.record_decision(0, 1, 1, 0)
    report(fleet, 2)
    before = fleet.base.copy()
    fleet.settle(0, 0, failed=True)
    fleet.settle(2, 0, failed=True)
    np.testing.assert_array_equal(fleet.base, before)
    fleet = visited()
    fleet.advance(1)
    fleet.settle(0, 0, failed=False)
    fleet.settle(0, 0, failed=True)
    assert fleet.queue(1)[0] == pytest.approx(5.0)


def test_a_visit_that_is_older_than_the_beacon_collects_nothing_of_it() -> None:
    fleet = visited()
    report(fleet, 5, uav=1)
    fleet.locate(0, 3, start(fleet), 0.0)
    fleet.record_decision(0, 3, 0, 0)
    fleet.advance(6)
    assert fleet.queue(6)[0] == pytest.approx(55.0)


# ---- positions


def test_with_an_error_of_the_position_the_place_on_the_trajectory_counts() -> None:
    fleet = FleetBelief(WORLD)
    x, y = start(fleet, 0, 700.0)
    fleet.locate(0, 0, (x + 9.0, y - 12.0), 700.0)
    assert fleet.uavs[0].position == (x, y)
    assert fleet.uavs[0].progress_m == 700.0
    # Without a reported progress the position itself counts.
    fleet.locate(0, 1, (x + 3.0, y))
    assert fleet.uavs[0].position == (x + 3.0, y)


def test_progress_far_from_the_position_is_not_believed() -> None:
    fleet = FleetBelief(WORLD)
    here = start(fleet, 0, 700.0)
    fleet.locate(0, 0, here, 100.0)
    assert fleet.uavs[0].progress_m == pytest.approx(700.0)


def flown(
    share: float, *, wraps: bool = False, steps: int = 12, again: int = 1, failed: bool | None = False
) -> FleetBelief:
    """A fleet whose UAV flies this share of each commanded way; ``wraps``: it counts anew in every lap."""
    fleet, progress = FleetBelief(WORLD), 1700.0
    length = fleet.trajectory(0).length_m
    for step in range(steps):
        reported = math.fmod(progress, length) if wraps else progress
        if failed is not None:
            fleet.settle(0, step - 1, failed)
        fleet.advance(step)
        for _ in range(again):
            fleet.locate(0, step, start(fleet, 0, progress), reported)
            fleet.measure(0, IDS[:0], np.array([]))
        fleet.record_decision(0, step, 0, 14)
        progress += 140.0 * share
    return fleet


@pytest.mark.parametrize("wraps", [False, True])
def test_still_air_is_no_wind_also_where_a_lap_begins_anew(wraps: bool) -> None:
    assert flown(1.0, wraps=wraps).drift.none


def test_a_lap_that_begins_anew_is_no_gust() -> None:
    np.testing.assert_allclose(flown(1.2, wraps=True).drift.wind, flown(1.2).drift.wind, atol=1e-9)
    assert not flown(1.2).drift.none
    np.testing.assert_array_equal(flown(1.2, failed=True).drift.wind, flown(1.2).drift.wind)


def test_a_decision_without_an_outcome_teaches_no_wind() -> None:
    """The UAV may not have got it, and flown at another velocity: half a way against half a gale look alike."""
    assert flown(0.5, failed=None).drift.none


# ---- what a failure says of the radio


def fails(times: int, **reported: Any) -> FleetBelief:
    """A fleet whose UAV 0 fails to collect from sensor 0 in so many steps, and hears its beacons."""
    reported = {"failed": True, "sensor": 0, "queue": 20.0, **reported}
    failed, sensor = reported.pop("failed"), reported.pop("sensor")
    fleet = FleetBelief(WORLD)
    for step in range(times + 1):
        if failed is not None and step:
            fleet.settle(0, step - 1, failed)
        report(fleet, step, **reported)
        fleet.record_decision(0, step, sensor, 0)
    return fleet


def test_two_failures_over_a_good_link_are_a_dead_radio() -> None:
    assert fails(1).channel.failures.dead == []
    assert fails(2).channel.failures.dead == [0]


@pytest.mark.parametrize(
    "reported",
    [
        {"failed": False},
        {"failed": None},
        {"battery": 0.0},
        {"battery": 1e-9},
        {"excess_db": np.array([40.0, 0.0, 0.0])},
        {"sensor": 2},
        {"heard": IDS[1:]},
    ],
    ids=["it succeeds", "the outcome is unknown", "battery flat", "battery below a packet", "weak", "far", "unheard"],
)
def test_no_radio_is_dead_where_something_else_explains_the_failures(reported: dict[str, Any]) -> None:
    assert fails(6, **reported).channel.failures.none


def test_a_failure_some_steps_ago_says_nothing_of_the_link_that_is_measured_now() -> None:
    reported = {}
    for step in (1, 2):
        fleet = visited()
        fleet.settle(0, 0, failed=True)
        report(fleet, step)
        reported[step] = not fleet.channel.failures.none
    assert reported == {1: True, 2: False}


def test_a_report_that_comes_again_teaches_nothing() -> None:
    fleet = visited(excess_db=np.full(3, 5.0))
    fleet.settle(0, 0, failed=True)
    for _ in range(5):
        report(fleet, 1, excess_db=np.full(3, 5.0))
    assert fleet.channel.failures.dead == []
    # Two reports of the two sensors within radio range.
    assert fleet.channel.radio_map.heard == 4
    np.testing.assert_array_equal(flown(1.2, again=3).drift.wind, flown(1.2).drift.wind)


def test_a_sensor_that_serves_one_of_three_uavs_has_no_dead_radio() -> None:
    fleet = FleetBelief(WORLD)
    for step in range(8):
        for uav in range(3):
            if step:
                fleet.settle(uav, step - 1, failed=uav > 0)
        for uav in range(3):
            report(fleet, step, uav)
        for uav in range(3):
            fleet.record_decision(uav, step, 0, 0)
    assert fleet.channel.failures.none


def test_the_rate_share_follows_what_visits_move() -> None:
    fleet, queue = FleetBelief(WORLD), 60.0
    for step in range(8):
        if step:
            fleet.settle(0, step - 1, failed=False)
        report(fleet, step, queue=queue)
        fleet.record_decision(0, step, 0, 0)
        # A quarter of the 60 packets, five arrivals, and another UAV's visit of no interest in between.
        queue = queue - 15.0 + 5.0 if queue > 30.0 else 60.0
    assert fleet.channel.share == pytest.approx(0.25, abs=0.08)


def test_a_restored_belief_learns_on_to_the_bit() -> None:
    random = np.random.default_rng(1)
    excess = random.normal(0.0, 6.0, (12, 3))
    queues = random.integers(0, 60, 12)
    whole, again = FleetBelief(WORLD), FleetBelief(WORLD)
    for step in range(12):
        for fleet in (whole, again):
            if step:
                fleet.settle(0, step - 1, failed=step % 3 == 0)
            report(fleet, step, excess_db=excess[step], queue=float(queues[step]))
            fleet.record_decision(0, step, step % 2, 0)
        if step % 4 == 1:
            state = again.state_dict()
            again = FleetBelief(WORLD)
            again.load_state_dict(state)
    ways = np.arange(0.0, 1200.0, 50.0)
    for name in ("packets", "hold"):
        np.testing.assert_array_equal(getattr(whole.links(0, ways), name), getattr(again.links(0, ways), name))
    np.testing.assert_array_equal(whole.queue(14), again.queue(14))
