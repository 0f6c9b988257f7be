"""Sensors' own readings in a mission: their step, what they change, and that a message counts once."""

from __future__ import annotations

import time
from typing import Any

import pytest

from service.api.mission_answers import status_of
from service.errors import Refused
from service.mission.events import Event, ReadingsMerged
from service.mission.mission import Mission
from shared.wire.readings import SensorReading
from shared.world.step_rule import Action
from tests.support.missions import attended, mission, uav


def reading(sensor_id: int = 9, queue: float = 20.0, **more: Any) -> SensorReading:
    return SensorReading(sensor_id=sensor_id, queue=queue, **more)


def flown(step: int) -> Mission:
    """A mission whose fleet has reported a step."""
    m = mission()
    m.observe(uav(step=step), step)
    return m


def at(m: Mission, seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clock show so many seconds since the newest step began."""
    now = m.readings.began[1] + seconds
    monkeypatch.setattr(time, "monotonic", lambda: now)


def test_a_uav_knows_a_sensor_that_no_uav_has_heard() -> None:
    m = flown(4)
    assert m.belief.heard[9] == -1
    assert m.read([reading(queue=55.0, battery=12.0, step=3)]) == ["merged"]
    assert (m.belief.heard[9], m.belief.base[9], m.belief.battery[9]) == (3, 55.0, 12.0)
    assert m.belief.base_variance[9] == 0
    # Rolled forward by its age.
    assert m.belief.queue(4)[9] == min(60.0, 55.0 + m.scenario.mean_arrival_rate)
    assert status_of(m).readings == 1


def test_a_battery_that_is_not_told_stays_as_it_was() -> None:
    m = flown(4)
    m.read([reading(battery=12.0, step=3)])
    m.read([reading(step=4)])
    assert m.belief.battery[9] == 12.0


@pytest.mark.parametrize(
    ("age_s", "since_began_s", "step"),
    [
        (0.0, 0.0, 7),
        (3.0, 4.0, 7),
        (4.0, 3.0, 6),
        (25.0, 5.0, 5),
        (10.0, 10.0, 7),
        (0.5, 300.0, 7),
        (3600.0, 0.0, -353),
    ],
)
def test_an_age_counts_back_from_the_beginning_of_the_newest_step(
    age_s: float, since_began_s: float, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    m = flown(7)
    at(m, since_began_s, monkeypatch)
    placed = m.readings.placed([reading(age_s=age_s)])
    assert placed is not None and placed[0].step == step


def test_a_step_begins_with_its_first_report_whoever_reports_later(monkeypatch: pytest.MonkeyPatch) -> None:
    m = flown(7)
    at(m, 15.0, monkeypatch)
    m.observe(uav(step=7, uav_id=1), 7)
    m.observe(uav(step=6, uav_id=2), 6)
    placed = m.readings.placed([reading(age_s=12.0), reading(age_s=16.0)])
    assert placed is not None and [one.step for one in placed] == [7, 6]


def test_in_a_restored_mission_the_newest_step_begins_now(monkeypatch: pytest.MonkeyPatch) -> None:
    again = mission()
    again.load_state_dict(flown(7).state_dict())
    at(again, 1e6, monkeypatch)
    placed = again.readings.placed([reading(age_s=0.0), reading(age_s=25.0)])
    assert placed is not None and [one.step for one in placed] == [7, 4]


def test_a_reading_from_before_the_first_step_is_a_known_beginning() -> None:
    m = flown(0)
    assert m.read([reading(queue=10.0, age_s=35.0)]) == ["merged"]
    assert (m.belief.heard[9], m.belief.since[9], m.belief.base_variance[9]) == (-1, -4, 0.0)
    assert m.belief.queue(0)[9] == 10.0 + 4 * m.scenario.mean_arrival_rate
    # A newer one replaces it, an older one does not, and a beacon replaces both.
    assert m.read([reading(queue=12.0, age_s=15.0)]) == ["merged"]
    assert m.read([reading(queue=9.0, age_s=55.0)]) == ["outdated"]
    assert m.belief.queue(0)[9] == 12.0 + 2 * m.scenario.mean_arrival_rate
    assert m.read([reading(queue=3.0, step=0)]) == ["merged"]
    assert m.belief.queue(0)[9] == 3.0


def test_before_the_first_report_no_age_has_a_step() -> None:
    m = mission()
    assert m.read([reading(age_s=1.0), reading(sensor_id=8, step=0)]) == ["early", "early"]
    assert status_of(m).readings is None


def test_what_is_older_than_a_beacon_or_a_reading_changes_nothing() -> None:
    m = flown(5)
    before = m.belief.base.copy()
    # Sensor 0 was heard in step 5.
    assert m.read([reading(sensor_id=0, step=5), reading(sensor_id=1, step=2)]) == ["outdated", "outdated"]
    assert (m.belief.base == before).all()
    assert m.read([reading(step=4)]) == ["merged"]
    assert m.read([reading(queue=1.0, step=4)]) == ["outdated"]
    assert m.belief.base[9] == 20.0


def test_a_reading_from_before_a_visit_does_not_bring_the_packets_back() -> None:
    m = mission()
    m.observe(uav(step=3, x=[500.0] * 6), 3)
    m.commit(attended(m, uav(step=3), 3).pending("0" * 32, Action(1, 0)))
    m.observe(uav(step=5, queue=[5.0]), 5)
    assert m.belief.visited[1] == 3
    collected = m.belief.base[1]
    assert m.read([reading(sensor_id=1, queue=60.0, step=3)]) == ["outdated"]
    assert m.belief.base[1] == collected
    assert m.read([reading(sensor_id=1, queue=7.0, step=4)]) == ["merged"]
    assert m.belief.base[1] == 7.0


def test_a_message_counts_once_even_where_its_age_is_rounded_to_a_later_step(monkeypatch: pytest.MonkeyPatch) -> None:
    m = flown(5)
    at(m, 0.0, monkeypatch)
    assert m.read([reading(age_s=12.0, message_id="a")]) == ["merged"]
    at(m, 14.0, monkeypatch)
    assert m.read([reading(age_s=12.0, message_id="a")]) == ["duplicate"]
    assert m.read([reading(age_s=12.0, message_id="b")]) == ["merged"]
    assert m.read([reading(sensor_id=8, age_s=12.0, message_id="b")]) == ["merged"]
    assert m.readings.merged == 3


def test_an_outdated_message_does_not_make_an_earlier_one_count_again(monkeypatch: pytest.MonkeyPatch) -> None:
    m = flown(5)
    at(m, 0.0, monkeypatch)
    assert m.read([reading(age_s=12.0, message_id="a")]) == ["merged"]
    assert m.read([reading(age_s=25.0, message_id="b")]) == ["outdated"]
    at(m, 14.0, monkeypatch)
    assert m.read([reading(age_s=12.0, message_id="a")]) == ["duplicate"]
    assert m.readings.merged == 1


def test_the_rate_is_learned_from_readings_as_from_beacons() -> None:
    m = flown(6)
    prior = float(m.belief.arrivals.rate[9])
    m.read([reading(queue=2.0, step=1)])
    m.read([reading(queue=42.0, step=6)])
    assert m.belief.arrivals.rate[9] > prior
    assert m.records.rates[9] > m.scenario.mean_arrival_rate


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"sensor_id": 10, "step": 1}, "readings[1].sensor_id"),
        ({"queue": 60.5, "step": 1}, "readings[1].queue"),
        ({"step": 8}, "readings[1].step"),
    ],
)
def test_a_reading_that_does_not_fit_the_world_is_named_and_nothing_is_merged(given: Any, field: str) -> None:
    m = flown(7)
    events: list[Event] = []
    m.record = events.append
    with pytest.raises(Refused) as refused:
        m.read([reading(sensor_id=8, step=7), reading(**given)])
    assert refused.value.field == field
    assert events == [] and m.readings.merged == 0


def test_only_what_changes_the_belief_is_an_event() -> None:
    m = flown(5)
    events: list[Event] = []
    m.record = events.append
    for _ in range(3):
        m.read([reading(step=5, message_id="a"), reading(sensor_id=0, step=5)])
    assert [[r.sensor_id for r in event.readings] for event in events if isinstance(event, ReadingsMerged)] == [[9]]
    assert len(events) == 1
