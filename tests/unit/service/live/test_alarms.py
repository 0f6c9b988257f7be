"""The alarms of UAVs, visits and batteries, for the page and for Prometheus."""

from __future__ import annotations

import pytest

from service.live.alarms import alarms
from service.live.fleet_watch import FleetWatch
from service.mission.mission import Mission
from shared.planning.orders import Guidance, SensorWish
from shared.wire.schemas import MissionSpec
from tests.support.missions import PAPER, mission, uav
from tests.support.waiting import Clock


def fly(fleet: Mission, step: int, number: int = 0, off_m: float = 0.0) -> None:
    """A report of a UAV so many metres east of the beginning of its trajectory."""
    x, y = fleet.belief.trajectory(number).at(0.0)
    fleet.observe(uav(step=step, uav_id=number, position=(float(x) + off_m, float(y)), last_seen=[step] * 6), step)


def found(fleet: Mission) -> dict[str, dict[int, int | None]]:
    return {kind: those for kind, those in alarms(fleet, fleet.deadlines(), {}).items() if those}


def test_a_uav_that_does_not_report_for_more_than_three_steps_is_lost() -> None:
    fleet = mission()
    fly(fleet, 5, number=1)
    fly(fleet, 8)
    assert found(fleet) == {}
    fly(fleet, 9)
    assert found(fleet) == {"uav_lost": {1: 5}}
    fly(fleet, 9, number=1)
    assert found(fleet) == {}


def test_a_uav_far_from_its_trajectory_is_off_its_path() -> None:
    fleet = mission()
    fly(fleet, 0, off_m=5.0)
    assert found(fleet) == {}
    fly(fleet, 1, off_m=60.0)
    assert found(fleet) == {"uav_off_path": {0: None}}


def test_a_lost_uav_is_not_off_its_path_too() -> None:
    fleet = mission()
    fly(fleet, 0, number=1, off_m=60.0)
    assert found(fleet) == {"uav_off_path": {1: None}}
    fly(fleet, 4)
    assert found(fleet) == {"uav_lost": {1: 0}}


def test_a_visit_is_late_once_its_step_is_past() -> None:
    fleet = mission()
    fly(fleet, 10)
    # The order begins at step 10, so that the first visit is due in one of the steps 10 to 12.
    fleet.visit_orders.follow(Guidance(sensors=[SensorWish(sensor_id=3, visit_every=3)]), 10)
    fly(fleet, 12)
    assert found(fleet) == {}
    fly(fleet, 13)
    assert found(fleet) == {"visit_late": {3: 12}}
    fleet.records.visits[3] = 13
    assert found(fleet) == {}
    fly(fleet, 17)
    fleet.visit_orders.follow(Guidance(), 17)
    assert found(fleet) == {}


def test_only_batteries_that_were_reported_are_low() -> None:
    fleet = mission()
    fly(fleet, 0)
    fleet.belief.battery[[2, 9]] = 0.1 * PAPER.battery_j
    assert fleet.belief.heard[9] < 0
    assert found(fleet) == {"sensor_battery": {2: None}}


def test_a_uavs_own_battery_is_an_alarm_as_long_as_its_newest_report_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    fleet, watch = mission(), FleetWatch()
    for step, percent in enumerate((25.0, 24.9, None)):
        fly(fleet, step)
        watch.decided(fleet, uav(step=step).model_copy(update={"battery_percent": percent}), step)
        clock.ahead_s += 10.0
        seen = watch.of("test")
        low = alarms(fleet, fleet.deadlines(), seen.batteries)["uav_battery"]
        assert (low, watch.alarms([fleet])["uav_battery"]) == (({0: None}, 1) if percent == 24.9 else ({}, 0))
    assert seen.step_took_s == pytest.approx(10.0, abs=1.0)


def test_missions_that_fly_now_count_and_silent_ones_have_lost_their_uavs(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    fleet, never, watch = mission(), mission(), FleetWatch()
    fly(fleet, 0, off_m=60.0)
    assert watch.alarms([fleet]) == {}
    watch.decided(fleet, uav(), 0)
    assert +watch.alarms([fleet, never]) == {"uav_off_path": 1}
    clock.ahead_s = 3 * PAPER.step_s + 30.0
    assert +watch.alarms([fleet]) == {"uav_off_path": 1, "uav_lost": 1}
    clock.ahead_s = 700.0
    assert watch.alarms([fleet]) == {}
    fly(fleet, PAPER.steps - 1, off_m=60.0)
    watch.decided(fleet, uav(), PAPER.steps - 1)
    assert watch.alarms([fleet]) == {}


def test_a_silent_fleet_has_lost_each_uav_once_also_past_its_scenarios_last_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    fleet, watch = mission(), FleetWatch()
    fly(fleet, 5, number=1)
    fly(fleet, PAPER.steps + 5)
    watch.decided(fleet, uav(step=PAPER.steps + 5), PAPER.steps + 5)
    assert +watch.alarms([fleet]) == {"uav_lost": 1}
    clock.ahead_s = 3 * PAPER.step_s + 30.0
    assert +watch.alarms([fleet]) == {"uav_lost": 2}
    assert set(watch.alarms_of(fleet)["uav_lost"]) == {0, 1}, "as `GET` of the mission has them"


def test_a_mission_that_was_loaded_again_and_not_decided_in_has_lost_nobody() -> None:
    slow, watch = mission(MissionSpec(scenario=PAPER.model_copy(update={"step_s": 150.0}))), FleetWatch()
    slow.observe(uav(), 0)
    assert +watch.alarms([slow]) == {} and watch.alarms_of(slow)["uav_lost"] == {}


def test_a_fleet_of_long_steps_is_lost_before_its_mission_counts_as_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    slow, watch = mission(MissionSpec(scenario=PAPER.model_copy(update={"step_s": 300.0}))), FleetWatch()
    slow.observe(uav(), 0)
    watch.decided(slow, uav(), 0)
    for ahead_s, lost in ((850.0, 0), (950.0, 1), (1750.0, 1), (1850.0, 0)):
        clock.ahead_s = ahead_s
        assert watch.alarms([slow])["uav_lost"] == lost
