"""A broker's messages: the newest reading of each device is buffered for the edge, and every message is counted."""

import logging
import math
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import islice
from typing import Any, Literal

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from pydantic import ValidationError
from pydantic_core import from_json

from field.lorawan.configuration import Configuration, Device
from field.lorawan.uplinks import DECODERS, DeviceMessage
from shared.kit.validation_messages import problem_of

_AGE_BUCKETS_S = (0.5, 1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600)
_RSSI_BUCKETS_DBM = (-140, -130, -125, -120, -115, -110, -105, -100, -90, -80, -60)
_SNR_BUCKETS_DB = (-20, -17.5, -15, -12.5, -10, -7.5, -5, -2.5, 0, 2.5, 5, 10)
log = logging.getLogger(__name__)
# The largest LoRaWAN payload has 242 bytes; the metadata of many gateways is some kilobytes.
_MAX_BYTES = 65_536
# The most that the clocks of network server and edge may differ.
_MAX_CLOCK_SKEW = timedelta(seconds=60)
# Message IDs remembered for each device, to detect duplicates.
_REMEMBERED_IDS = 8
# Warnings at most, one a device and reason: anyone at the broker can make up devices.
MOST_WARNINGS = 10_000
# Field names in a warning, and characters of each.
_NAMES_SHOWN, _NAME_LENGTH = 20, 60
_EPOCH = datetime.min.replace(tzinfo=UTC)
MessageResult = Literal[
    "accepted", "battery", "duplicate", "foreign", "future", "no_queue", "outdated", "simulated", "too_large",
    "too_old", "unknown_device", "unreadable",
]  # fmt: skip


class MqttMetrics:
    """The metrics of one process, in their own registry."""

    def __init__(self) -> None:
        self.registry = r = CollectorRegistry()
        counter, gauge = partial(Counter, registry=r), partial(Gauge, registry=r)
        histogram = partial(Histogram, registry=r)
        self.uplinks = counter("aicvds_mqtt_uplinks", "Messages of the broker by what became of them", ["result"])
        self.readings = counter("aicvds_mqtt_readings", "Readings sent to the edge by its answer", ["result"])
        self.failures = counter("aicvds_mqtt_edge_failures", "Requests that the edge did not answer well")
        self.connects = counter("aicvds_mqtt_connects", "Connections to the broker by result", ["result"])
        self.connected = gauge("aicvds_mqtt_connected", "Whether the broker is subscribed to, 1 or 0")
        self.waiting = gauge("aicvds_mqtt_waiting", "Readings that wait for the edge, at most one a device")
        sent, best = "Age of a reading as it is sent to the edge", "at the gateway that heard an uplink best"
        self.age_s = histogram("aicvds_mqtt_age_seconds", sent, buckets=_AGE_BUCKETS_S)
        self.rssi_dbm = histogram("aicvds_mqtt_rssi_dbm", f"Signal strength {best}", buckets=_RSSI_BUCKETS_DBM)
        self.snr_db = histogram("aicvds_mqtt_snr_db", f"Signal-to-noise ratio {best}", buckets=_SNR_BUCKETS_DB)


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
    newest: datetime = _EPOCH
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=_REMEMBERED_IDS))
    battery_percent: float | None = None
    battery_at: datetime = _EPOCH


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
        self._warned: set[tuple[str, MessageResult]] = set()

    def add_message(self, payload: bytes, now: datetime | None = None, topic: str = "") -> MessageResult:
        """Decode a message and buffer its reading; returns and counts the result.

        A message that cannot be used is logged once a device and reason, with the names of its fields.
        """
        with self._lock:
            result = self._result_of(payload, now or datetime.now(UTC), topic)
            self._metrics.waiting.set(len(self._readings))
        self._metrics.uplinks.labels(result).inc()
        return result

    def _result_of(self, payload: bytes, now: datetime, topic: str) -> MessageResult:
        if len(payload) > _MAX_BYTES:
            return self._unused(topic, "too_large", f"it has {len(payload)} bytes")
        try:
            uplink = self._decode(payload)
        except (ValidationError, ValueError, OverflowError) as error:
            return self._unused(topic, "unreadable", _fault(payload, error))
        eui, network = uplink.dev_eui, self._configuration.network
        if uplink.application != network.application or (network.tenant and uplink.tenant != network.tenant):
            reason = f"its application is {_shown(uplink.application)}, its tenant {_shown(uplink.tenant)}"
            return self._unused(eui, "foreign", reason)
        state = self._devices.get(eui)
        if state is None:
            return self._unused(eui, "unknown_device", "the file has no [[device]] with this dev_eui")
        if uplink.simulated:
            return "simulated"
        age_s = (now - uplink.at).total_seconds()
        if uplink.at > now + _MAX_CLOCK_SKEW:
            return self._unused(eui, "future", f"it is {-age_s:.0f} s ahead of this machine's clock")
        if uplink.message_id in state.messages:
            return "duplicate"
        if uplink.has_battery and uplink.at >= state.battery_at:
            state.battery_at, state.battery_percent = uplink.at, uplink.battery_percent
        if uplink.fields is None:
            return "battery"
        if age_s > network.max_age_s:
            return self._unused(eui, "too_old", f"it is {age_s:.0f} s old")
        if uplink.at <= state.newest:
            return "outdated"
        return self._add_reading(uplink, state)

    def _unused(self, device: str, result: MessageResult, reason: str) -> MessageResult:
        if (device, result) not in self._warned and len(self._warned) < MOST_WARNINGS:
            self._warned.add((device, result))
            log.warning("%s: %s: %s; further ones are only counted", _shown(device), result, reason)
        return result

    def _add_reading(self, uplink: DeviceMessage, state: _DeviceState) -> MessageResult:
        payload = self._configuration.payload
        queue = _number(uplink.fields, payload.queue)
        if queue is None or queue < 0:
            found = _field(uplink.fields, payload.queue)
            wrong = f"field {_shown(payload.queue)} is {'missing' if found is None else _shown(found)}"
            has = _has(_paths(uplink.fields)) if uplink.fields else "the network server has no decoder for its bytes"
            return self._unused(uplink.dev_eui, "no_queue", f"{wrong}; {has}")
        percent = state.battery_percent
        if payload.battery is not None:
            own = _number(uplink.fields, payload.battery)
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


def _number(fields: Any, name: str) -> float | None:
    """A number in the decoded payload by its name; None where there is none."""
    value = _field(fields, name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _field(value: Any, name: str) -> Any:
    """A part of the decoded payload: dots lead into objects and lists, unless a field's own name has them."""
    if isinstance(value, list):
        head, _, rest = name.partition(".")
        part = value[int(head)] if head.isdecimal() and int(head) < len(value) else None
        return _field(part, rest) if rest else part
    if not isinstance(value, Mapping):
        return None
    if name in value:
        return value[name]
    splits = (at for at, letter in enumerate(name) if letter == "." and name[:at] in value)
    found = (_field(value[name[:at]], name[at + 1 :]) for at in splits)
    return next((part for part in found if part is not None), None)


def _paths(value: Any, before: str = "") -> Iterator[str]:
    """The names of a payload's values, as the file may name them."""
    if not isinstance(value, Mapping | list):
        yield before
        return
    for name, part in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _paths(part, f"{before}.{name}" if before else str(name))


def _fault(payload: bytes, error: Exception) -> str:
    """What is wrong with a message, and the names of its fields at the top level."""
    if not isinstance(error, ValidationError):
        return "a value cannot be read"
    first = error.errors(include_url=False)[0]
    if first["type"] == "json_invalid":
        return "it is no JSON"
    message = from_json(payload)
    names = message if isinstance(message, Mapping) else ()
    return f"{'.'.join(map(str, first['loc']))} {problem_of(first)}; {_has(names)}"


def _has(names: Iterable[str]) -> str:
    return f"it has {', '.join(_shown(name) for name in islice(names, _NAMES_SHOWN)) or 'no fields'}"


def _shown(text: object) -> str:
    """A broker's text for the log: quoted, on one line."""
    return repr(text)[:_NAME_LENGTH]
