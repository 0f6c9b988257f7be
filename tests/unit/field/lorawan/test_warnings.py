"""What the log says of messages that cannot be used: one line a device and reason, whatever is in them."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest

from tests.support.lorawan_messages import NOW, chirpstack_up, dev_eui, packed
from tests.unit.field.lorawan.test_pending_readings import reading_buffer, take

V3 = {"applicationID": "1", "applicationName": "p", "devEUI": "0004a30b001c0530", "data": "EUI=", "object": {}}
EUI = dev_eui(0)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (V3, "'up/1': unreadable: time is missing; it has 'applicationID', 'applicationName', 'devEUI', 'data'"),
        (chirpstack_up(time="noon"), "'up/1': unreadable: time must be a valid date"),
        (b"\xff", "'up/1': unreadable: it is no JSON"),
        (b"[1]", "'up/1': unreadable"),
        (b"7", "'up/1': unreadable"),
        (b"x" * 70_000, "'up/1': too_large: it has 70000 bytes"),
        (chirpstack_up(object=None), f"'{EUI}': no_queue: field 'queue' is missing; the network server has no decoder"),
        (
            chirpstack_up(object={"level": {"queue": 3}, "list": [1, {"x": 2}]}),
            f"'{EUI}': no_queue: field 'queue' is missing; it has 'level.queue', 'list.0', 'list.1.x'",
        ),
        (chirpstack_up(queue="3 pk\n\u202e"), "no_queue: field 'queue' is '3 pk\\n\\u202e'; it has 'queue'"),
        (chirpstack_up(queue=-4), "no_queue: field 'queue' is -4; "),
        (chirpstack_up(device=9), f"'{dev_eui(9)}': unknown_device: the file has no [[device]] with this dev_eui"),
        (chirpstack_up(time="2026-11-23T13:00:01Z"), f"'{EUI}': future: it is 3600 s ahead of this machine's clock"),
        (chirpstack_up(time="2026-11-23T10:00:01Z"), f"'{EUI}': too_old: it is 7200 s old"),
        (
            chirpstack_up(deviceInfo={"applicationId": "a\nb", "devEui": EUI}),
            f"'{EUI}': foreign: its application is 'a\\nb', its tenant None",
        ),
    ],
)
def test_what_cannot_be_used_is_logged_once_a_device_and_reason(
    message: dict[str, Any] | bytes, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    pending = reading_buffer()
    for _ in range(3):
        pending.add_message(
            message if isinstance(message, bytes) else packed(message), NOW + timedelta(seconds=1), "up/1"
        )
    (line,) = caplog.messages
    assert said in line and "\n" not in line and len(line) < 1500
    assert take(pending, chirpstack_up(device=1)) == "accepted"
    assert len(caplog.messages) == 1


def test_made_up_devices_do_not_flood_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("field.lorawan.pending_readings.MOST_WARNINGS", 5)
    pending = reading_buffer()
    for number in range(10, 30):
        assert take(pending, chirpstack_up(device=number)) == "unknown_device"
    assert len(caplog.messages) == 5
