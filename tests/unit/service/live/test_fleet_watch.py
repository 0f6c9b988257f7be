"""What the reports say about a fleet's troubles."""

from __future__ import annotations

import pytest

from service.live.fleet_watch import FleetWatch
from service.mission.mission import Mission
from shared.wire.schemas import UavState
from tests.support.missions import mission, uav
from tests.support.waiting import Clock


def watch(fleet: Mission, *reports: UavState) -> FleetWatch:
    watched = FleetWatch()
    for step, state in enumerate(reports):
        fleet.observe(state, step)
        watched.decided(fleet, state, step)
    return watched


def test_full_queues_are_counted_once_a_step() -> None:
    fleet = mission()
    seen = watch(fleet, *(uav(step=step, queue=[60.0, 60.0, 1.0], last_seen=[step] * 3) for step in range(3)))
    unheard = seen.of("test").full[2] - 2
    # The other seven sensors were never heard; they are believed to fill slowly.
    assert 0 <= unheard < 7
    assert seen.of("test").totals()["overflows"] == pytest.approx(sum(seen.of("test").full.values()), abs=0.1)
    assert all(seen.of("test").full[step] >= 2 for step in range(3))


def test_overflows_are_counted_on_when_their_steps_are_forgotten() -> None:
    seen = watch(mission(), *(uav(step=step, queue=[60.0, 60.0], last_seen=[step] * 2) for step in range(320)))
    assert len(seen.of("test").full) == 300
    assert seen.of("test").totals()["overflows"] >= 640


def test_a_report_again_at_the_same_step_counts_once() -> None:
    fleet, watched = mission(), FleetWatch()
    for _ in range(3):
        state = uav(queue=[60.0, 1.0])
        fleet.observe(state, 0)
        watched.decided(fleet, state, 0)
    assert list(watched.of("test").full) == [0]


def test_a_sensor_in_radio_range_that_is_not_heard_is_silent_until_it_is() -> None:
    fleet = mission()
    silent = uav(step=0, queue=[10.0, None], x=[500.0, 600.0])
    far = uav(step=0, queue=[10.0, None], x=[500.0, 5000.0])
    heard = uav(step=2, queue=[10.0, 5.0], x=[500.0, 600.0])
    watched = watch(fleet, silent)
    assert watched.of("test").silent == {1: 0}
    assert watch(mission(), far).of("test").silent == {}
    fleet.observe(heard, 2)
    watched.decided(fleet, heard, 2)
    assert watched.of("test").silent == {}


def test_a_forgotten_mission_begins_anew() -> None:
    watched = watch(mission(), uav())
    assert watched.of("test").totals()["idle_s"] is not None
    watched.forget("test")
    assert watched.of("test").totals()["idle_s"] is None


def test_a_step_took_the_time_between_the_first_reports_of_two_consecutive_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, fleet, watched = Clock(), mission(), FleetWatch()
    monkeypatch.setattr("service.live.fleet_watch.time", clock)
    # The second report of step 1 begins no step, and steps 2 to 4 are missing.
    for step, ahead_s in ((0, 0.0), (1, 1000.0), (1, 1500.0), (5, 9000.0)):
        clock.ahead_s = ahead_s
        fleet.observe(uav(step=step), step)
        watched.decided(fleet, uav(step=step), step)
    assert watched.of("test").step_took_s == pytest.approx(1000.0, abs=100.0)
