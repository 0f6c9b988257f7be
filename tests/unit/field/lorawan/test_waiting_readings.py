"""What becomes of a broker's messages: two servers' forms, duplicates, late and foreign ones, floods and nonsense."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from field.lorawan.configuration import Configuration
from field.lorawan.counts import Counts
from field.lorawan.uplinks import Uplink, chirpstack, the_things_stack
from field.lorawan.waiting_readings import Intake, Taken, Waiting
from tests.unit.field.lorawan.messages import (
    APPLICATION,
    NOW,
    TENANT,
    chirpstack_status,
    chirpstack_up,
    dev_eui,
    packed,
    the_things_stack_up,
)

DEVICES = 3


def configuration(server: str = "chirpstack", **payload: Any) -> Configuration:
    things = server == "the-things-stack"
    return Configuration.model_validate(
        {
            "broker": {"url": "mqtt://localhost"},
            "network": {
                "server": server,
                "application": "pipeline" if things else APPLICATION,
                "tenant": "ttn" if things else TENANT,
            },
            "payload": {"queue": "level.queue" if things else "queue", "battery_full_j": 50.0, **payload},
            "device": [{"dev_eui": dev_eui(number), "sensor_id": 10 + number} for number in range(DEVICES)],
        }
    )


def intake(server: str = "chirpstack", **payload: Any) -> Intake:
    return Intake(configuration(server, **payload), Counts())


def take(taking: Intake, message: dict[str, Any], later_s: float = 1.0) -> Taken:
    return taking.take(packed(message), NOW + timedelta(seconds=later_s))


def waiting(taking: Intake, later_s: float = 60.0) -> list[Waiting]:
    due = taking.due(NOW + timedelta(seconds=later_s))
    return [reading for readings in due.values() for reading in readings]


@pytest.mark.parametrize(
    ("server", "message", "battery"),
    [("chirpstack", chirpstack_up, None), ("the-things-stack", the_things_stack_up, 45.0)],
)
def test_an_uplink_is_a_reading_of_its_sensor(
    server: str, message: Callable[..., dict[str, Any]], battery: float | None
) -> None:
    taking = intake(server)
    assert take(taking, message(device=2, queue=17)) == "accepted"
    (reading,) = waiting(taking)
    assert (reading.mission_id, reading.sensor_id, reading.queue, reading.battery) == ("default", 12, 17.0, battery)
    # To a microsecond.
    assert abs(reading.at - NOW) < timedelta(milliseconds=1)
    assert waiting(taking) == []
    registry = taking._counts.registry
    assert [registry.get_sample_value(f"aicvds_mqtt_{name}_count") for name in ("rssi_dbm", "snr_db")] == [1, 1]


@pytest.mark.parametrize(
    ("decode", "message", "best"),
    [(chirpstack, chirpstack_up, (-96, 7.25)), (the_things_stack, the_things_stack_up, (-35, 5.2))],
)
def test_of_several_gateways_the_one_that_heard_best_counts(
    decode: Callable[[bytes], Uplink], message: Callable[..., dict[str, Any]], best: tuple[float, float]
) -> None:
    uplink = decode(packed(message()))
    assert (uplink.rssi_dbm, uplink.snr_db) == best


def test_a_first_frame_counter_is_left_out() -> None:
    taking = intake("the-things-stack")
    assert take(taking, the_things_stack_up(f_cnt=0)) == "accepted"


def test_a_queue_of_zero_is_a_reading() -> None:
    taking = intake(packets_per_unit=4)
    assert take(taking, chirpstack_up(queue=0)) == "accepted"
    assert take(taking, chirpstack_up(device=1, queue=2.5)) == "accepted"
    assert [reading.queue for reading in waiting(taking)] == [0.0, 10.0]


@pytest.mark.parametrize(
    ("fields", "battery_j"),
    [({"queue": 1, "battery": 20}, 10.0), ({"queue": 1}, 37.75), ({"queue": 1, "battery": 101}, 37.75)],
)
def test_the_payloads_battery_counts_before_the_networks(fields: dict[str, Any], battery_j: float) -> None:
    taking = intake(battery="battery")
    assert take(taking, chirpstack_status()) == "battery"
    assert take(taking, chirpstack_up(object=fields)) == "accepted"
    assert waiting(taking)[0].battery == battery_j


@pytest.mark.parametrize("changes", [{"batteryLevelUnavailable": True}, {"externalPowerSource": True}])
def test_a_battery_that_the_device_does_not_know_says_nothing(changes: dict[str, Any]) -> None:
    taking = intake()
    assert take(taking, chirpstack_status(**changes)) == "battery"
    assert take(taking, chirpstack_up(f_cnt=2)) == "accepted"
    assert waiting(taking)[0].battery is None


def test_a_message_that_is_delivered_again_is_a_duplicate() -> None:
    taking = intake()
    assert [take(taking, chirpstack_up()) for _ in range(3)] == ["accepted", "duplicate", "duplicate"]
    assert len(waiting(taking)) == 1
    assert take(taking, chirpstack_up()) == "duplicate"


def test_an_older_message_that_comes_later_does_not_replace_the_newer_one() -> None:
    taking = intake()
    assert take(taking, chirpstack_up(queue=30, f_cnt=2)) == "accepted"
    assert take(taking, chirpstack_up(queue=10, f_cnt=1, at=NOW - timedelta(seconds=20))) == "outdated"
    assert [reading.queue for reading in waiting(taking)] == [30.0]


def test_a_frame_counter_that_begins_again_is_no_duplicate() -> None:
    taking = intake()
    assert take(taking, chirpstack_up(deduplicationId="", f_cnt=0)) == "accepted"
    assert take(taking, chirpstack_up(deduplicationId="", f_cnt=0, at=NOW + timedelta(seconds=30)), 31) == "accepted"


@pytest.mark.parametrize(
    ("changed", "taken"),
    [
        ({"deviceInfo": {"tenantId": TENANT, "applicationId": "other", "devEui": dev_eui(0)}}, "foreign"),
        ({"deviceInfo": {"tenantId": "other", "applicationId": APPLICATION, "devEui": dev_eui(0)}}, "foreign"),
        ({"deviceInfo": {"applicationId": APPLICATION, "devEui": dev_eui(0)}}, "foreign"),
        ({"deviceInfo": {"tenantId": TENANT, "applicationId": APPLICATION, "devEui": dev_eui(7)}}, "unknown_device"),
        ({"deviceInfo": {"tenantId": TENANT, "applicationId": APPLICATION, "devEui": "xyz"}}, "unreadable"),
        ({"object": None}, "no_queue"),
        ({"object": {"level": 3}}, "no_queue"),
        ({"object": {"queue": "3"}}, "no_queue"),
        ({"object": {"queue": True}}, "no_queue"),
        ({"object": {"queue": -1}}, "no_queue"),
        ({"object": {"queue": float("nan")}}, "no_queue"),
        ({"object": {"queue": 10**400}}, "no_queue"),
        ({"object": {"queue": 1e308 * 10}}, "no_queue"),
        ({"object": {"queue": {"queue": 3}}}, "no_queue"),
        ({"time": "2026-11-23T12:30:00Z"}, "future"),
        ({"time": "2026-11-23T09:00:00Z"}, "too_old"),
        ({"time": "yesterday"}, "unreadable"),
        ({"time": "2026-11-23T12:00:00"}, "unreadable"),
        ({"data": "A" * 70_000}, "too_large"),
    ],
)
def test_what_cannot_count_is_counted(changed: dict[str, Any], taken: Taken) -> None:
    taking = intake()
    assert take(taking, chirpstack_up(**changed)) == taken
    assert waiting(taking) == []
    assert taking._counts.registry.get_sample_value("aicvds_mqtt_uplinks_total", {"result": taken}) == 1
    # And it does not stand in the way of the next.
    assert take(taking, chirpstack_up(f_cnt=9)) == "accepted"


def test_an_uplink_that_somebody_simulates_in_the_console_is_no_reading() -> None:
    assert take(intake("the-things-stack"), the_things_stack_up(simulated=True)) == "simulated"


def test_other_messages_of_the_things_stack_are_unreadable() -> None:
    joined = the_things_stack_up()
    del joined["uplink_message"]
    assert take(intake("the-things-stack"), joined) == "unreadable"


def test_a_flood_leaves_one_reading_a_device() -> None:
    taking = intake()
    for number in range(3000):
        message = chirpstack_up(
            device=number % DEVICES, queue=number % 50, f_cnt=number, at=NOW + timedelta(milliseconds=number)
        )
        assert take(taking, message, 60) == "accepted"
    assert taking._counts.registry.get_sample_value("aicvds_mqtt_waiting") == DEVICES
    assert sorted(reading.queue for reading in waiting(taking)) == [47.0, 48.0, 49.0]
    assert all(len(known.messages) <= 8 for known in taking._devices.values())


def test_a_reading_that_is_put_back_gives_way_to_a_newer_one() -> None:
    taking = intake()
    take(taking, chirpstack_up(queue=1))
    take(taking, chirpstack_up(device=1, queue=2))
    old = waiting(taking)
    take(taking, chirpstack_up(queue=9, f_cnt=2, at=NOW + timedelta(seconds=5)), 6)
    taking.put_back(old)
    assert sorted(reading.queue for reading in waiting(taking)) == [2.0, 9.0]


def test_a_reading_that_waited_too_long_is_dropped() -> None:
    taking = intake()
    assert take(taking, chirpstack_up()) == "accepted"
    assert take(taking, chirpstack_up(device=1, at=NOW + timedelta(seconds=50))) == "accepted"
    assert [reading.sensor_id for reading in waiting(taking, 3601.0)] == [11]
    assert taking._counts.registry.get_sample_value("aicvds_mqtt_readings_total", {"result": "too_old"}) == 1


@pytest.mark.parametrize("server", ["chirpstack", "the-things-stack"])
@given(payload=st.binary(max_size=200) | st.from_regex(rb'\{"(time|object|deviceInfo)":[^}]{0,40}\}?', fullmatch=True))
def test_nonsense_is_unreadable_and_breaks_nothing(server: str, payload: bytes) -> None:
    assert intake(server).take(payload) == "unreadable"


def test_deeply_nested_json_is_unreadable(tmp_path: Path) -> None:
    message = packed(chirpstack_up()).replace(b'"queue": 17', b'"queue": ' + b"[" * 5000 + b"]" * 5000)
    assert intake().take(message, NOW) in ("unreadable", "no_queue")
