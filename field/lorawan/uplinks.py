"""The messages of two LoRaWAN network servers by their documentation: an uplink, and a battery status.

ChirpStack v4 (``integration.proto``, as JSON) and The Things Stack v3 (data formats, MQTT server). Fields that are
empty or zero may be missing. A field that only describes the link, the device or the network never costs a message its
queue: it is unknown where it has another type.
"""

import hashlib
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, TypeVar

from pydantic import AliasChoices, AliasPath, AwareDatetime, BaseModel, Field, ValidationError, WrapValidator
from pydantic import ValidatorFunctionWrapHandler as Validate


@dataclass(frozen=True, slots=True)
class DeviceMessage:
    """One message of a device.

    Attributes:
        dev_eui: 16 hexadecimal digits, lower case.
        message_id: the same for each delivery of the message.
        at: when the network received it.
        fields: the payload as the network server's decoder made it, without one an empty object; None for a message
            with nothing but the battery level.
        has_battery: whether the message says what the network knows of the battery, even if that is nothing.
        battery_percent: the battery level that the device reported to the network, 0..100, if known.
        rssi_dbm, snr_db: at the gateway with the strongest reception, if known.
    """

    dev_eui: str
    tenant: str | None
    application: str
    message_id: str
    at: datetime
    fields: Any
    has_battery: bool
    battery_percent: float | None
    rssi_dbm: float | None
    snr_db: float | None
    simulated: bool = False


_Eui = Annotated[str, Field(pattern=r"^[0-9A-Fa-f]{16}$")]


def _unknown(value: Any, validate: Validate) -> Any:
    try:
        return validate(value)
    except ValidationError:
        return None


_T = TypeVar("_T")
# A field that is None where it has another type or an impossible value.
_Optional = Annotated[_T | None, WrapValidator(_unknown)]
_Percent = _Optional[Annotated[float, Field(ge=0, le=100)]]
_Text = _Optional[str]


class _Reception(BaseModel):
    rssi: _Optional[Annotated[float, Field(allow_inf_nan=False)]] = None
    snr: _Optional[Annotated[float, Field(allow_inf_nan=False)]] = None


_Receptions = _Optional[Annotated[list[_Optional[_Reception]], Field(max_length=1000)]]


class _Battery(BaseModel):
    value: _Percent = None


class _ChirpStack(BaseModel):
    """``StatusEvent``, or ``UplinkEvent``: its ``time`` is by any gateway's clock, ``ns_time`` by the server's."""

    deduplication_id: _Text = Field(None, alias="deduplicationId")
    time: AwareDatetime
    ns_time: _Optional[AwareDatetime] = Field(None, validation_alias=AliasPath("rxInfo", 0, "nsTime"))
    tenant_id: _Text = Field(None, validation_alias=AliasPath("deviceInfo", "tenantId"))
    application_id: str = Field(validation_alias=AliasPath("deviceInfo", "applicationId"))
    dev_eui: _Eui = Field(validation_alias=AliasPath("deviceInfo", "devEui"))
    f_cnt: _Optional[int] = Field(None, alias="fCnt")
    margin: Any = None
    object: Any = None
    rx_info: _Receptions = Field(None, alias="rxInfo")
    battery_level: _Percent = Field(None, alias="batteryLevel")
    battery_level_unavailable: _Optional[bool] = Field(None, alias="batteryLevelUnavailable")
    external_power_source: _Optional[bool] = Field(None, alias="externalPowerSource")


class _TheThingsStack(BaseModel):
    """``ApplicationUp`` with an ``uplink_message``."""

    application_id: str = Field(validation_alias=AliasPath("end_device_ids", "application_ids", "application_id"))
    dev_eui: _Eui = Field(validation_alias=AliasPath("end_device_ids", "dev_eui"))
    simulated: _Optional[bool] = None
    received_at: AwareDatetime = Field(
        validation_alias=AliasChoices(AliasPath("uplink_message", "received_at"), "received_at")
    )
    uplink_message: dict[str, Any]
    f_cnt: _Optional[int] = Field(None, validation_alias=AliasPath("uplink_message", "f_cnt"))
    decoded_payload: Any = Field(None, validation_alias=AliasPath("uplink_message", "decoded_payload"))
    rx_metadata: _Receptions = Field(None, validation_alias=AliasPath("uplink_message", "rx_metadata"))
    battery: _Optional[_Battery] = Field(None, validation_alias=AliasPath("uplink_message", "last_battery_percentage"))
    tenant_id: _Text = Field(None, validation_alias=AliasPath("uplink_message", "network_ids", "tenant_id"))


# Fields of a status event that no uplink has.
_STATUS = frozenset(("margin", "battery_level", "battery_level_unavailable", "external_power_source"))


def chirpstack(payload: bytes) -> DeviceMessage:
    """An event ``up`` or ``status`` of ChirpStack v4 in JSON; raises pydantic's ``ValidationError``."""
    event = _ChirpStack.model_validate_json(payload)
    known = None if event.battery_level_unavailable else event.battery_level
    is_status = not _STATUS.isdisjoint(event.model_fields_set)
    return DeviceMessage(
        dev_eui=event.dev_eui.lower(),
        tenant=event.tenant_id or None,
        application=event.application_id,
        message_id=_message_id(event.dev_eui, event.deduplication_id or event.f_cnt or 0, event.time),
        at=event.ns_time or event.time,
        fields={} if event.object is None and not is_status else event.object,
        has_battery=is_status,
        # Where it gets none, the edge keeps the battery that it knew.
        battery_percent=100.0 if event.external_power_source else known,
        **_best_reception(event.rx_info),
    )


def the_things_stack(payload: bytes) -> DeviceMessage:
    """An uplink message of The Things Stack v3; raises pydantic's ``ValidationError``."""
    uplink = _TheThingsStack.model_validate_json(payload)
    return DeviceMessage(
        dev_eui=uplink.dev_eui.lower(),
        tenant=uplink.tenant_id or None,
        application=uplink.application_id,
        message_id=_message_id(uplink.dev_eui, uplink.f_cnt or 0, uplink.received_at),
        at=uplink.received_at,
        fields={} if uplink.decoded_payload is None else uplink.decoded_payload,
        # Every uplink repeats what the server knows.
        has_battery=True,
        battery_percent=None if uplink.battery is None else uplink.battery.value,
        simulated=bool(uplink.simulated),
        **_best_reception(uplink.rx_metadata),
    )


DECODERS = {"chirpstack": chirpstack, "the-things-stack": the_things_stack}


def _message_id(dev_eui: str, number: str | int, at: datetime) -> str:
    """32 hexadecimal digits. A frame counter begins again after a join, so the number alone is not enough."""
    return hashlib.sha256(f"{dev_eui.lower()} {number} {at.isoformat()}".encode()).hexdigest()[:32]


def _best_reception(receptions: list[_Reception | None] | None) -> dict[str, Any]:
    known = [one for one in receptions or () if one is not None]
    best = max(known, key=lambda one: -1e9 if one.rssi is None else one.rssi, default=_Reception())
    return {"rssi_dbm": best.rssi, "snr_db": best.snr}
