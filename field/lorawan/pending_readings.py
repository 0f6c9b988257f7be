"""A broker's messages: the newest reading of each device is buffered for the edge, and every message is counted."""

import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

from pydantic import ValidationError

from field.lorawan.configuration import Configuration, Device
from field.lorawan.mqtt_metrics import MqttMetrics
from field.lorawan.uplinks import DECODERS, DeviceMessage

# The largest LoRaWAN payload has 242 bytes; the metadata of many gateways is some kilobytes.
_MAX_BYTES = 65_536
# The most that the clocks of network server and edge may differ.
_MAX_CLOCK_SKEW = timedelta(seconds=60)
# Message IDs remembered for each device, to detect duplicates.
_REMEMBERED_IDS = 8

MessageResult = Literal[
    "accepted", "battery", "duplicate", "foreign", "future", "no_queue", "outdated", "simulated", "too_large",
    "too_old", "unknown_device", "unreadable",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class PendingReading:
    """A reading that waits for the edge; ``battery`` in J, if known."""

    mission_id: str
    sensor_id: int
    queue: float
    battery: float | None
    at: datetime
    message_id: str


@dataclass(slots=True)
class _DeviceState:
    """A device's newest message, and the battery level that the network reported."""

    device: Device
    newest: datetime = datetime.min.replace(tzinfo=UTC)
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=_REMEMBERED_IDS))
    battery_percent: float | None = None


class ReadingBuffer:
    """Takes messages in the MQTT client's thread, and hands readings to another.

    It stores one reading a device, the newest, however many messages arrive and however long the edge is unavailable.
    """

    def __init__(self, configuration: Configuration, metrics: MqttMetrics) -> None:
        self._configuration = configuration
        self._decode = DECODERS[configuration.network.server]
        self._metrics = metrics
        self._devices = {device.dev_eui.lower(): _DeviceState(device) for device in configuration.device}
        self._lock = threading.Lock()
        self._readings: dict[tuple[str, int], PendingReading] = {}

    def add_message(self, payload: bytes, now: datetime | None = None) -> MessageResult:
        """Decode a message and buffer its reading; returns and counts the result."""
        with self._lock:
            result = self._result_of(payload, now or datetime.now(UTC))
            self._metrics.waiting.set(len(self._readings))
        self._metrics.uplinks.labels(result).inc()
        return result

    def _result_of(self, payload: bytes, now: datetime) -> MessageResult:
        if len(payload) > _MAX_BYTES:
            return "too_large"
        try:
            uplink = self._decode(payload)
        except (ValidationError, ValueError, OverflowError):
            return "unreadable"
        network = self._configuration.network
        if uplink.application != network.application or (network.tenant and uplink.tenant != network.tenant):
            return "foreign"
        state = self._devices.get(uplink.dev_eui)
        if state is None:
            return "unknown_device"
        if uplink.simulated:
            return "simulated"
        if uplink.at > now + _MAX_CLOCK_SKEW:
            return "future"
        if uplink.message_id in state.messages:
            return "duplicate"
        if uplink.battery_percent is not None:
            state.battery_percent = uplink.battery_percent
        if uplink.fields is None:
            return "battery"
        if (now - uplink.at).total_seconds() > network.max_age_s:
            return "too_old"
        if uplink.at <= state.newest:
            return "outdated"
        return self._add_reading(uplink, state, uplink.fields)

    def _add_reading(self, uplink: DeviceMessage, state: _DeviceState, fields: Mapping[str, Any]) -> MessageResult:
        payload = self._configuration.payload
        queue = _number(fields, payload.queue)
        if queue is None or queue < 0:
            return "no_queue"
        percent = state.battery_percent
        if payload.battery is not None:
            own = _number(fields, payload.battery)
            percent = own if own is not None and 0 <= own <= 100 else percent
        full_j = payload.battery_full_j
        state.newest = uplink.at
        state.messages.append(uplink.message_id)
        self._keep_newest(
            PendingReading(
                mission_id=self._configuration.mission_of(state.device),
                sensor_id=state.device.sensor_id,
                queue=queue * payload.packets_per_unit,
                battery=None if percent is None or full_j is None else percent / 100 * full_j,
                at=uplink.at,
                message_id=uplink.message_id,
            )
        )
        if uplink.rssi_dbm is not None:
            self._metrics.rssi_dbm.observe(uplink.rssi_dbm)
        if uplink.snr_db is not None:
            self._metrics.snr_db.observe(uplink.snr_db)
        return "accepted"

    def _keep_newest(self, reading: PendingReading) -> None:
        key = reading.mission_id, reading.sensor_id
        there = self._readings.get(key)
        if there is None or there.at < reading.at:
            self._readings[key] = reading

    def drain(self, now: datetime | None = None) -> dict[str, list[PendingReading]]:
        """Remove and return the buffered readings, by mission; those that have become too old are dropped."""
        now = now or datetime.now(UTC)
        with self._lock:
            waiting, self._readings = self._readings, {}
            self._metrics.waiting.set(0)
        by_mission: dict[str, list[PendingReading]] = {}
        for reading in waiting.values():
            if (now - reading.at).total_seconds() > self._configuration.network.max_age_s:
                self._metrics.readings.labels("too_old").inc()
            else:
                by_mission.setdefault(reading.mission_id, []).append(reading)
        return by_mission

    def put_back(self, readings: list[PendingReading]) -> None:
        """Buffer readings again, unless newer ones of their sensors are buffered already."""
        with self._lock:
            for reading in readings:
                self._keep_newest(reading)
            self._metrics.waiting.set(len(self._readings))


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
