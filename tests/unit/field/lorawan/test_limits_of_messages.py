"""Messages right at a limit: of age, of the clocks' difference, of size, and of the IDs that are remembered."""

from __future__ import annotations

from datetime import timedelta

import pytest

from field.lorawan.pending_readings import MessageResult, MqttMetrics, ReadingBuffer
from tests.support.lorawan_messages import NOW, chirpstack_up, packed
from tests.unit.field.lorawan.test_pending_readings import configuration, reading_buffer, take, waiting

MAX_AGE_S = configuration().network.max_age_s
MINUTE = timedelta(seconds=60)
MICROSECOND = timedelta(microseconds=1)


@pytest.mark.parametrize(
    ("age", "result"),
    [
        (timedelta(seconds=MAX_AGE_S), "accepted"),
        (timedelta(seconds=MAX_AGE_S) + MICROSECOND, "too_old"),
        (-MINUTE, "accepted"),
        (-MINUTE - MICROSECOND, "future"),
    ],
)
def test_a_message_of_exactly_the_greatest_age_or_clock_skew_counts(age: timedelta, result: MessageResult) -> None:
    pending, message = reading_buffer(), chirpstack_up() | {"time": NOW.isoformat()}
    assert pending.add_message(packed(message), NOW + age) == result


def test_a_reading_that_waited_to_exactly_the_greatest_age_is_sent() -> None:
    pending, message = reading_buffer(), chirpstack_up() | {"time": NOW.isoformat()}
    assert take(pending, message) == "accepted"
    assert len(waiting(pending, MAX_AGE_S)) == 1


def test_a_message_of_64_kib_is_read_and_one_byte_more_is_too_much() -> None:
    payload = packed(chirpstack_up())
    largest = payload + b" " * (65_536 - len(payload))
    assert reading_buffer().add_message(largest, NOW) == "accepted"
    assert reading_buffer().add_message(largest + b" ", NOW) == "too_large"


def test_another_message_of_the_same_instant_replaces_no_reading() -> None:
    pending = reading_buffer()
    assert take(pending, chirpstack_up(queue=5, f_cnt=1)) == "accepted"
    assert take(pending, chirpstack_up(queue=9, f_cnt=2)) == "outdated"
    assert [reading.queue for reading in waiting(pending)] == [5.0]


def test_a_message_that_comes_again_after_seven_others_is_still_a_duplicate() -> None:
    pending = reading_buffer()
    messages = [chirpstack_up(f_cnt=number, at=NOW + timedelta(seconds=number)) for number in range(8)]
    assert {take(pending, message, 10.0) for message in messages} == {"accepted"}
    assert {take(pending, message, 10.0) for message in messages} == {"duplicate"}


def test_no_reading_waits_once_they_are_taken_and_one_again_once_it_is_put_back() -> None:
    metrics = MqttMetrics()
    pending = ReadingBuffer(configuration(), metrics)

    def shown() -> float | None:
        return metrics.registry.get_sample_value("aicvds_mqtt_waiting")

    assert take(pending, chirpstack_up()) == "accepted"
    assert shown() == 1
    taken = waiting(pending)
    assert shown() == 0
    pending.put_back(taken)
    assert shown() == 1
