"""What comes of a broker's messages: the newest reading of each device waits for the edge, and the rest is counted."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

from pydantic import ValidationError

from field.lorawan.configuration import Configuration, Device
from field.lorawan.counts import Counts
from field.lorawan.uplinks import DECODERS, Uplink

# The largest LoRaWAN payload has 242 bytes; the metadata of many gateways is some kilobytes.
_MOST_BYTES = 65_536
# The clocks of network server and edge may differ by so much.
_AHEAD = timedelta(seconds=60)
# Messages of a device that are known again.
_KNOWN = 8

Taken = Literal[
    "accepted", "battery", "duplicate", "foreign", "future", "no_queue", "outdated", "simulated", "too_large",
    "too_old", "unknown_device", "unreadable",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Waiting:
    """A reading that waits for the edge; ``battery`` in J, if known."""

    mission_id: str
    sensor_id: int
    queue: float
    battery: float | None
    at: datetime
    message_id: str


@dataclass(slots=True)
class _Known:
    """What is known of a device: its newest message, and its battery as the network told it."""

    device: Device
    newest: datetime = datetime.min.replace(tzinfo=UTC)
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=_KNOWN))
    battery_percent: float | None = None


class Intake:
    """Takes messages in the MQTT client's thread, and hands readings to another.

    It holds one reading a device, the newest, however many messages come and however long the edge is away.
    """

    def __init__(self, configuration: Configuration, counts: Counts) -> None:
        self._configuration = configuration
        self._decode = DECODERS[configuration.network.server]
        self._counts = counts
        self._devices = {device.dev_eui.lower(): _Known(device) for device in configuration.device}
        self._lock = threading.Lock()
        self._waiting: dict[tuple[str, int], Waiting] = {}

    def take(self, payload: bytes, now: datetime | None = None) -> Taken:
        """Take a message, whatever it is; returns and counts what became of it."""
        with self._lock:
            taken = self._take(payload, now or datetime.now(UTC))
            self._counts.waiting.set(len(self._waiting))
        self._counts.uplinks.labels(taken).inc()
        return taken

    def _take(self, payload: bytes, now: datetime) -> Taken:
        if len(payload) > _MOST_BYTES:
            return "too_large"
        try:
            uplink = self._decode(payload)
        except (ValidationError, ValueError, OverflowError):
            return "unreadable"
        network = self._configuration.network
        if uplink.application != network.application or (network.tenant and uplink.tenant != network.tenant):
            return "foreign"
        known = self._devices.get(uplink.dev_eui)
        if known is None:
            return "unknown_device"
        if uplink.simulated:
            return "simulated"
        if uplink.at > now + _AHEAD:
            return "future"
        if uplink.message_id in known.messages:
            return "duplicate"
        if uplink.battery_percent is not None:
            known.battery_percent = uplink.battery_percent
        if uplink.fields is None:
            return "battery"
        if (now - uplink.at).total_seconds() > network.max_age_s:
            return "too_old"
        if uplink.at <= known.newest:
            return "outdated"
        return self._accept(uplink, known, uplink.fields)

    def _accept(self, uplink: Uplink, known: _Known, fields: Mapping[str, Any]) -> Taken:
        payload = self._configuration.payload
        queue = _number(fields, payload.queue)
        if queue is None or queue < 0:
            return "no_queue"
        percent = known.battery_percent
        if payload.battery is not None:
            own = _number(fields, payload.battery)
            percent = own if own is not None and 0 <= own <= 100 else percent
        full_j = payload.battery_full_j
        known.newest = uplink.at
        known.messages.append(uplink.message_id)
        self._await(
            Waiting(
                mission_id=self._configuration.mission_of(known.device),
                sensor_id=known.device.sensor_id,
                queue=queue * payload.packets_per_unit,
                battery=None if percent is None or full_j is None else percent / 100 * full_j,
                at=uplink.at,
                message_id=uplink.message_id,
            )
        )
        if uplink.rssi_dbm is not None:
            self._counts.rssi_dbm.observe(uplink.rssi_dbm)
        if uplink.snr_db is not None:
            self._counts.snr_db.observe(uplink.snr_db)
        return "accepted"

    def _await(self, reading: Waiting) -> None:
        key = reading.mission_id, reading.sensor_id
        there = self._waiting.get(key)
        if there is None or there.at < reading.at:
            self._waiting[key] = reading

    def due(self, now: datetime | None = None) -> dict[str, list[Waiting]]:
        """The waiting readings by mission; they wait no longer. Those that have become too old are dropped."""
        now = now or datetime.now(UTC)
        with self._lock:
            waiting, self._waiting = self._waiting, {}
            self._counts.waiting.set(0)
        by_mission: dict[str, list[Waiting]] = {}
        for reading in waiting.values():
            if (now - reading.at).total_seconds() > self._configuration.network.max_age_s:
                self._counts.readings.labels("too_old").inc()
            else:
                by_mission.setdefault(reading.mission_id, []).append(reading)
        return by_mission

    def put_back(self, readings: list[Waiting]) -> None:
        """Let readings wait again, unless newer ones of their sensors wait already."""
        with self._lock:
            for reading in readings:
                self._await(reading)
            self._counts.waiting.set(len(self._waiting))


def _number(fields: Mapping[str, Any], name: str) -> float | None:
    """A number in the decoded payload by its name, with dots for nested objects; None where there is none."""
    value: Any = fields
    for part in name.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(part)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
