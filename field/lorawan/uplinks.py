"""The messages of two LoRaWAN network servers by their documentation: an uplink, and a battery status.

ChirpStack v4 (``integration.proto``, as JSON) and The Things Stack v3 (data formats, MQTT server). Fields that are
empty or zero may be missing.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

from pydantic import AliasPath, AwareDatetime, BaseModel, Field


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


_Eui = Annotated[str, Field(pattern=r"^[0-9A-Fa-f]{16}$")]
_Percent = Annotated[float, Field(ge=0, le=100)]


class _Reception(BaseModel):
    rssi: float | None = None
    snr: float | None = None


class _Battery(BaseModel):
    value: _Percent = 0.0


class _ChirpStack(BaseModel):
    """``UplinkEvent`` or ``StatusEvent``."""

    deduplication_id: str = Field("", alias="deduplicationId")
    time: AwareDatetime
    tenant_id: str = Field("", validation_alias=AliasPath("deviceInfo", "tenantId"))
    application_id: str = Field(validation_alias=AliasPath("deviceInfo", "applicationId"))
    dev_eui: _Eui = Field(validation_alias=AliasPath("deviceInfo", "devEui"))
    f_cnt: int = Field(0, alias="fCnt")
    object: dict[str, Any] | None = None
    rx_info: list[_Reception] = Field([], alias="rxInfo", max_length=1000)
    battery_level: _Percent | None = Field(None, alias="batteryLevel")
    battery_level_unavailable: bool = Field(False, alias="batteryLevelUnavailable")
    external_power_source: bool = Field(False, alias="externalPowerSource")


class _TheThingsStack(BaseModel):
    """``ApplicationUp`` with an ``uplink_message``."""

    application_id: str = Field(validation_alias=AliasPath("end_device_ids", "application_ids", "application_id"))
    dev_eui: _Eui = Field(validation_alias=AliasPath("end_device_ids", "dev_eui"))
    simulated: bool = False
    received_at: AwareDatetime = Field(validation_alias=AliasPath("uplink_message", "received_at"))
    f_cnt: int = Field(0, validation_alias=AliasPath("uplink_message", "f_cnt"))
    decoded_payload: dict[str, Any] | None = Field(
        None, validation_alias=AliasPath("uplink_message", "decoded_payload")
    )
    rx_metadata: list[_Reception] = Field(
        [], validation_alias=AliasPath("uplink_message", "rx_metadata"), max_length=1000
    )
    battery: _Battery | None = Field(None, validation_alias=AliasPath("uplink_message", "last_battery_percentage"))
    tenant_id: str = Field("", validation_alias=AliasPath("uplink_message", "network_ids", "tenant_id"))


def chirpstack(payload: bytes) -> DeviceMessage:
    """An event ``up`` or ``status`` of ChirpStack v4 in JSON; raises pydantic's ``ValidationError``."""
    event = _ChirpStack.model_validate_json(payload)
    mains = event.external_power_source or event.battery_level_unavailable
    return DeviceMessage(
        dev_eui=event.dev_eui.lower(),
        tenant=event.tenant_id or None,
        application=event.application_id,
        message_id=_message_id(event.dev_eui, event.deduplication_id or event.f_cnt, event.time),
        at=event.time,
        fields=None if event.object is None and event.battery_level is not None else event.object or {},
        battery_percent=None if mains else event.battery_level,
        **_best_reception(event.rx_info),
    )


def the_things_stack(payload: bytes) -> DeviceMessage:
    """An uplink message of The Things Stack v3; raises pydantic's ``ValidationError``."""
    uplink = _TheThingsStack.model_validate_json(payload)
    return DeviceMessage(
        dev_eui=uplink.dev_eui.lower(),
        tenant=uplink.tenant_id or None,
        application=uplink.application_id,
        message_id=_message_id(uplink.dev_eui, uplink.f_cnt, uplink.received_at),
        at=uplink.received_at,
        fields=uplink.decoded_payload or {},
        battery_percent=None if uplink.battery is None else uplink.battery.value,
        simulated=uplink.simulated,
        **_best_reception(uplink.rx_metadata),
    )


DECODERS = {"chirpstack": chirpstack, "the-things-stack": the_things_stack}


def _message_id(dev_eui: str, number: str | int, at: datetime) -> str:
    """32 hexadecimal digits. A frame counter begins again after a join, so the number alone is not enough."""
    return hashlib.sha256(f"{dev_eui.lower()} {number} {at.isoformat()}".encode()).hexdigest()[:32]


def _best_reception(receptions: list[_Reception]) -> dict[str, Any]:
    best = max(receptions, key=lambda one: -1e9 if one.rssi is None else one.rssi, default=_Reception())
    return {"rssi_dbm": best.rssi, "snr_db": best.snr}
