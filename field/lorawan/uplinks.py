"""The messages of two LoRaWAN network servers by their documentation: an uplink, and a battery status.

ChirpStack v4 (``integration.proto``, as JSON) and The Things Stack v3 (data formats, MQTT server). Fields that are
empty or zero may be missing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel


@dataclass(frozen=True, slots=True)
class DeviceMessage:
    """One message of a device.

    Attributes:
        dev_eui: 16 hexadecimal digits, lower case.
        message_id: the same for each delivery of the message.
        at: when the network received it.
        fields: the decoded payload; None for a message with nothing but the battery level.
        battery_percent: the battery level that the device reported to the network, 0..100, if known.
        rssi_dbm, snr_db: at the gateway with the strongest reception, if known.
    """

    dev_eui: str
    tenant: str | None
    application: str
    message_id: str
    at: datetime
    fields: Mapping[str, Any] | None
    battery_percent: float | None
    rssi_dbm: float | None
    snr_db: float | None
    simulated: bool = False


class _ChirpStackModel(BaseModel):
    model_config = ConfigDict(extra="ignore", alias_generator=to_camel, frozen=True)


class _DeviceInfo(_ChirpStackModel):
    tenant_id: str = ""
    application_id: str
    dev_eui: str = Field(pattern=r"^[0-9A-Fa-f]{16}$")


class _Reception(_ChirpStackModel):
    rssi: float | None = None
    snr: float | None = None


class _ChirpStack(_ChirpStackModel):
    """``UplinkEvent`` or ``StatusEvent``."""

    deduplication_id: str = ""
    time: AwareDatetime
    device_info: _DeviceInfo
    f_cnt: int = 0
    object: dict[str, Any] | None = None
    rx_info: list[_Reception] = Field(default_factory=list, max_length=1000)
    battery_level: float | None = Field(None, ge=0, le=100)
    battery_level_unavailable: bool = False
    external_power_source: bool = False


class _TtsModel(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _ApplicationIds(_TtsModel):
    application_id: str


class _DeviceIds(_TtsModel):
    application_ids: _ApplicationIds
    dev_eui: str = Field(pattern=r"^[0-9A-Fa-f]{16}$")


class _Battery(_TtsModel):
    value: float = Field(0.0, ge=0, le=100)


class _NetworkIds(_TtsModel):
    tenant_id: str = ""


class _TtsUplink(_TtsModel):
    f_cnt: int = 0
    received_at: AwareDatetime
    decoded_payload: dict[str, Any] | None = None
    rx_metadata: list[_Reception] = Field(default_factory=list, max_length=1000)
    last_battery_percentage: _Battery | None = None
    network_ids: _NetworkIds = _NetworkIds()


class _TheThingsStack(_TtsModel):
    """``ApplicationUp`` with an ``uplink_message``."""

    end_device_ids: _DeviceIds
    uplink_message: _TtsUplink
    simulated: bool = False


def chirpstack(payload: bytes) -> DeviceMessage:
    """An event ``up`` or ``status`` of ChirpStack v4 in JSON; raises pydantic's ``ValidationError``."""
    event = _ChirpStack.model_validate_json(payload)
    device = event.device_info
    mains = event.external_power_source or event.battery_level_unavailable
    return DeviceMessage(
        dev_eui=device.dev_eui.lower(),
        tenant=device.tenant_id or None,
        application=device.application_id,
        message_id=_message_id(device.dev_eui, event.deduplication_id or event.f_cnt, event.time),
        at=event.time,
        fields=None if event.object is None and event.battery_level is not None else event.object or {},
        battery_percent=None if mains else event.battery_level,
        **_best_reception(event.rx_info),
    )


def the_things_stack(payload: bytes) -> DeviceMessage:
    """An uplink message of The Things Stack v3; raises pydantic's ``ValidationError``."""
    uplink = _TheThingsStack.model_validate_json(payload)
    device, message = uplink.end_device_ids, uplink.uplink_message
    battery = message.last_battery_percentage
    return DeviceMessage(
        dev_eui=device.dev_eui.lower(),
        tenant=message.network_ids.tenant_id or None,
        application=device.application_ids.application_id,
        message_id=_message_id(device.dev_eui, message.f_cnt, message.received_at),
        at=message.received_at,
        fields=message.decoded_payload or {},
        battery_percent=None if battery is None else battery.value,
        simulated=uplink.simulated,
        **_best_reception(message.rx_metadata),
    )


DECODERS = {"chirpstack": chirpstack, "the-things-stack": the_things_stack}


def _message_id(dev_eui: str, number: str | int, at: datetime) -> str:
    """32 hexadecimal digits. A frame counter begins again after a join, so the number alone is not enough."""
    return hashlib.sha256(f"{dev_eui.lower()} {number} {at.isoformat()}".encode()).hexdigest()[:32]


def _best_reception(receptions: list[_Reception]) -> dict[str, Any]:
    best = max(receptions, key=lambda one: -1e9 if one.rssi is None else one.rssi, default=_Reception())
    return {"rssi_dbm": best.rssi, "snr_db": best.snr}
