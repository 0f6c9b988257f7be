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
from field.lorawan.pending_readings import MessageResult, MqttMetrics, PendingReading, ReadingBuffer
from field.lorawan.uplinks import DeviceMessage, chirpstack, the_things_stack
from tests.support.lorawan_messages import (
    APPLICATION,
    NOW,
    TENANT,
    chirpstack_status,
    chirpstack_up,
    dev_eui,
    packed,
    rfc3339,
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


def reading_buffer(server: str = "chirpstack", **payload: Any) -> ReadingBuffer:
    return ReadingBuffer(configuration(server, **payload), MqttMetrics())


def take(pending: ReadingBuffer, message: dict[str, Any], later_s: float = 1.0) -> MessageResult:
    return pending.add_message(packed(message), NOW + timedelta(seconds=later_s))


def waiting(pending: ReadingBuffer, later_s: float = 60.0) -> list[PendingReading]:
    due = pending.drain(NOW + timedelta(seconds=later_s))
    return [reading for readings in due.values() for reading in readings]


@pytest.mark.parametrize(
    ("server", "message", "battery"),
    [("chirpstack", chirpstack_up, None), ("the-things-stack", the_things_stack_up, 45.0)],
)
def test_an_uplink_is_a_reading_of_its_sensor(
    server: str, message: Callable[..., dict[str, Any]], battery: float | None
) -> None:
    pending = reading_buffer(server)
    assert take(pending, message(device=2, queue=17)) == "accepted"
    (reading,) = waiting(pending)
    assert (reading.mission_id, reading.sensor_id, reading.queue, reading.battery) == ("default", 12, 17.0, battery)
    # To a microsecond.
    assert abs(reading.at - NOW) < timedelta(milliseconds=1)
    assert waiting(pending) == []
    registry = pending._metrics.registry
    assert [registry.get_sample_value(f"aicvds_mqtt_{name}_count") for name in ("rssi_dbm", "snr_db")] == [1, 1]


@pytest.mark.parametrize(
    ("decode", "message", "best"),
    [(chirpstack, chirpstack_up, (-96, 7.25)), (the_things_stack, the_things_stack_up, (-35, 5.2))],
)
def test_of_several_gateways_the_one_that_heard_best_counts(
    decode: Callable[[bytes], DeviceMessage], message: Callable[..., dict[str, Any]], best: tuple[float, float]
) -> None:
    uplink = decode(packed(message()))
    assert (uplink.rssi_dbm, uplink.snr_db) == best


def test_a_first_frame_counter_is_left_out() -> None:
    pending = reading_buffer("the-things-stack")
    assert take(pending, the_things_stack_up(f_cnt=0)) == "accepted"


def test_a_queue_of_zero_is_a_reading() -> None:
    pending = reading_buffer(packets_per_unit=4)
    assert take(pending, chirpstack_up(queue=0)) == "accepted"
    assert take(pending, chirpstack_up(device=1, queue=2.5)) == "accepted"
    assert [reading.queue for reading in waiting(pending)] == [0.0, 10.0]


@pytest.mark.parametrize(
    ("fields", "battery_j"),
    [({"queue": 1, "battery": 20}, 10.0), ({"queue": 1}, 37.75), ({"queue": 1, "battery": 101}, 37.75)],
)
def test_the_payloads_battery_counts_before_the_networks(fields: dict[str, Any], battery_j: float) -> None:
    pending = reading_buffer(battery="battery")
    assert take(pending, chirpstack_status()) == "battery"
    assert take(pending, chirpstack_up(object=fields)) == "accepted"
    assert waiting(pending)[0].battery == battery_j


@pytest.mark.parametrize(
    ("changes", "battery_j"), [({"batteryLevelUnavailable": True}, None), ({"externalPowerSource": True}, 50.0)]
)
def test_a_battery_that_the_device_does_not_know_says_nothing_and_the_mains_is_full(
    changes: dict[str, Any], battery_j: float | None
) -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_status(**changes)) == "battery"
    assert take(pending, chirpstack_up(f_cnt=2)) == "accepted"
    assert waiting(pending)[0].battery == battery_j


def test_a_message_that_is_delivered_again_is_a_duplicate() -> None:
    pending = reading_buffer()
    assert [take(pending, chirpstack_up()) for _ in range(3)] == ["accepted", "duplicate", "duplicate"]
    assert len(waiting(pending)) == 1
    assert take(pending, chirpstack_up()) == "duplicate"


def test_an_older_message_that_comes_later_does_not_replace_the_newer_one() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up(queue=30, f_cnt=2)) == "accepted"
    assert take(pending, chirpstack_up(queue=10, f_cnt=1, at=NOW - timedelta(seconds=20))) == "outdated"
    assert [reading.queue for reading in waiting(pending)] == [30.0]


def test_gateways_with_wrong_clocks_make_no_reading_outdated() -> None:
    pending = reading_buffer()
    for f_cnt in range(1, 7):
        at = NOW + timedelta(seconds=10 * f_cnt)
        # Every other uplink comes first through a gateway whose clock is ahead.
        ahead = timedelta(seconds=45 * (f_cnt % 2))
        message = chirpstack_up(f_cnt=f_cnt, at=at + ahead, rxInfo=[{"nsTime": rfc3339(at)}])
        assert take(pending, message, 10 * f_cnt + 1.0) == "accepted"


@pytest.mark.parametrize("received", [None, [], {}, [{}], [{"nsTime": None}], [{"nsTime": "soon"}], [5]])
def test_without_the_servers_time_the_events_counts(received: object) -> None:
    assert chirpstack(packed(chirpstack_up(rxInfo=received))).at == chirpstack(packed(chirpstack_up())).at


def test_a_frame_counter_that_begins_again_is_no_duplicate() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up(deduplicationId="", f_cnt=0)) == "accepted"
    assert take(pending, chirpstack_up(deduplicationId="", f_cnt=0, at=NOW + timedelta(seconds=30)), 31) == "accepted"


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
def test_what_cannot_count_is_counted(changed: dict[str, Any], taken: MessageResult) -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up(**changed)) == taken
    assert waiting(pending) == []
    assert pending._metrics.registry.get_sample_value("aicvds_mqtt_uplinks_total", {"result": taken}) == 1
    # And it does not stand in the way of the next.
    assert take(pending, chirpstack_up(f_cnt=9)) == "accepted"


def test_an_uplink_that_somebody_simulates_in_the_console_is_no_reading() -> None:
    assert take(reading_buffer("the-things-stack"), the_things_stack_up(simulated=True)) == "simulated"


def test_other_messages_of_the_things_stack_are_unreadable() -> None:
    joined = the_things_stack_up()
    del joined["uplink_message"]
    assert take(reading_buffer("the-things-stack"), joined) == "unreadable"


def test_a_flood_leaves_one_reading_a_device() -> None:
    pending = reading_buffer()
    for number in range(3000):
        message = chirpstack_up(
            device=number % DEVICES, queue=number % 50, f_cnt=number, at=NOW + timedelta(milliseconds=number)
        )
        assert take(pending, message, 60) == "accepted"
    assert pending._metrics.registry.get_sample_value("aicvds_mqtt_waiting") == DEVICES
    assert sorted(reading.queue for reading in waiting(pending)) == [47.0, 48.0, 49.0]
    assert all(len(known.messages) <= 8 for known in pending._devices.values())


def test_a_reading_that_is_put_back_gives_way_to_a_newer_one() -> None:
    pending = reading_buffer()
    take(pending, chirpstack_up(queue=1))
    take(pending, chirpstack_up(device=1, queue=2))
    old = waiting(pending)
    take(pending, chirpstack_up(queue=9, f_cnt=2, at=NOW + timedelta(seconds=5)), 6)
    pending.put_back(old)
    assert sorted(reading.queue for reading in waiting(pending)) == [2.0, 9.0]


def test_a_reading_that_waited_too_long_is_dropped() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up()) == "accepted"
    assert take(pending, chirpstack_up(device=1, at=NOW + timedelta(seconds=50))) == "accepted"
    assert [reading.sensor_id for reading in waiting(pending, 3601.0)] == [11]
    assert pending._metrics.registry.get_sample_value("aicvds_mqtt_readings_total", {"result": "too_old"}) == 1


@pytest.mark.parametrize("server", ["chirpstack", "the-things-stack"])
@given(payload=st.binary(max_size=200) | st.from_regex(rb'\{"(time|object|deviceInfo)":[^}]{0,40}\}?', fullmatch=True))
def test_nonsense_is_unreadable_and_breaks_nothing(server: str, payload: bytes) -> None:
    assert reading_buffer(server).add_message(payload) == "unreadable"


def test_deeply_nested_json_is_unreadable(tmp_path: Path) -> None:
    message = packed(chirpstack_up()).replace(b'"queue": 17', b'"queue": ' + b"[" * 5000 + b"]" * 5000)
    assert reading_buffer().add_message(message, NOW) in ("unreadable", "no_queue")


ODD: tuple[Any, ...] = (
    None,
    "x",
    -1,
    3.5,
    True,
    [],
    {},
    [None],
    ["x"],
    [{"rssi": "x", "snr": {}}],
    {"value": "x"},
    10**400,
    "\u202e",
)
CHIRPSTACK_METADATA = [
    *("deduplicationId", "fCnt", "fPort", "rxInfo", "txInfo", "devAddr", "adr", "dr", "confirmed", "data", "margin"),
    *("batteryLevel", "batteryLevelUnavailable", "externalPowerSource"),
]
THINGS_METADATA = [
    *("f_cnt", "f_port", "rx_metadata", "settings", "last_battery_percentage", "session_key_id", "frm_payload"),
    *("consumed_airtime", "packet_error_rate", "locations"),
]


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("name", CHIRPSTACK_METADATA)
def test_metadata_of_chirpstack_never_costs_a_queue(name: str, odd: object) -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up(**dict[str, Any]({name: odd}))) == "accepted"
    assert [reading.queue for reading in waiting(pending)] == [17.0]


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("name", THINGS_METADATA)
def test_metadata_of_the_things_stack_never_costs_a_queue(name: str, odd: object) -> None:
    pending, message = reading_buffer("the-things-stack"), the_things_stack_up()
    message["uplink_message"][name] = odd
    message["correlation_ids"] = message["simulated"] = None
    assert take(pending, message) == "accepted"
    assert [reading.queue for reading in waiting(pending)] == [17.0]


def test_the_things_stacks_other_time_counts_where_the_uplink_has_none() -> None:
    pending, message = reading_buffer("the-things-stack"), the_things_stack_up()
    del message["uplink_message"]["received_at"]
    assert take(pending, message) == "accepted"


LATER: dict[str, Any] = {"at": NOW + timedelta(seconds=10), "f_cnt": 2}


@pytest.mark.parametrize(
    "changes",
    [
        {"batteryLevelUnavailable": True, "batteryLevel": 0},
        {"batteryLevel": None},
        {"batteryLevel": 255},
        {"batteryLevel": "full"},
        {"batteryLevel": float("nan")},
    ],
)
def test_a_battery_that_chirpstack_no_longer_knows_is_unknown(changes: dict[str, Any]) -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_status(batteryLevel=80.0)) == "battery"
    assert take(pending, chirpstack_status(at=NOW + timedelta(seconds=5), **changes), 6) == "battery"
    assert take(pending, chirpstack_up(**LATER), 11) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [None]


def test_a_sensor_that_was_flat_and_is_on_external_power_is_flat_no_longer() -> None:
    """The edge keeps the battery that it knew where it gets none."""
    pending = reading_buffer()
    assert take(pending, chirpstack_status(batteryLevel=0.0)) == "battery"
    again = chirpstack_status(at=NOW + timedelta(seconds=5), externalPowerSource=True, batteryLevel=0)
    assert take(pending, again, 6) == "battery"
    assert take(pending, chirpstack_up(**LATER), 11) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [50.0]


def test_a_status_with_nothing_but_its_margin_is_an_unknown_battery() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_status(batteryLevel=80.0)) == "battery"
    status = chirpstack_status(at=NOW + timedelta(seconds=5))
    for name in ("batteryLevel", "batteryLevelUnavailable", "externalPowerSource"):
        del status[name]
    assert take(pending, status, 6) == "battery"
    assert take(pending, chirpstack_up(**LATER), 11) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [None]


def test_an_older_status_that_comes_later_changes_no_battery() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_status(batteryLevel=40.0, at=NOW + timedelta(seconds=5)), 6) == "battery"
    assert take(pending, chirpstack_status(batteryLevel=80.0), 7) == "battery"
    assert take(pending, chirpstack_up(**LATER), 11) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [20.0]


@pytest.mark.parametrize(
    ("battery", "joules"),
    [({"f_cnt": 1}, None), ({"value": None}, None), (None, None), ({"value": 101}, None), ({"value": 0}, 0.0)],
)
def test_a_battery_of_the_things_stack_without_a_value_is_unknown(battery: object, joules: float | None) -> None:
    pending = reading_buffer("the-things-stack")
    assert take(pending, the_things_stack_up()) == "accepted"
    message = the_things_stack_up(**LATER)
    message["uplink_message"]["last_battery_percentage"] = battery
    assert take(pending, message, 11) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [joules]
    del message["uplink_message"]["last_battery_percentage"]
    message["uplink_message"]["received_at"] = "2026-11-23T12:00:20Z"
    assert take(pending, message, 21) == "accepted"
    assert [reading.battery for reading in waiting(pending)] == [None]


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("level.queue", {"level": {"queue": 7}}),
        ("Queue length (packets)", {"Queue length (packets)": 7}),
        ("Water level.Now", {"Water level": {"Now": 7}}),
        ("sensors.1.level", {"sensors": [{"level": 1}, {"level": 7}]}),
        ("0.queue", [{"queue": 7}]),
        ("messages.0.1.value", {"messages": [[{"value": 1}, {"value": 7}]]}),
        ("niv.", {"niv.": 7}),
        ("a.b", {"a.b": 7, "a": {"b": 3}}),
        ("a.b.c", {"a.b": {"c": 7}, "a": {"b": {}}}),
        ("a.b.c", {"a": {"b.c": 7}}),
        ("\u6c34\u4f4d", {"\u6c34\u4f4d": 7}),
        (" ", {" ": 7}),
    ],
)
def test_whatever_a_decoder_calls_its_field(name: str, fields: object) -> None:
    pending = reading_buffer(queue=name)
    assert take(pending, chirpstack_up(object=fields)) == "accepted"
    assert [reading.queue for reading in waiting(pending)] == [7.0]


@pytest.mark.parametrize("name", ["2.queue", "-1.queue", "queue", "0", "0.queue.x", ".", "\u00b2.queue"])
def test_a_field_that_a_list_lacks_is_no_queue(name: str) -> None:
    assert take(reading_buffer(queue=name), chirpstack_up(object=[{"queue": 7}])) == "no_queue"
