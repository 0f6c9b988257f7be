"""The file of ``aicvds mqtt``: the broker, the network's names, the payload's fields, and the sensor of each device."""

import tomllib
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from shared.kit.text_files import text_of
from shared.kit.validation_messages import problem_of
from shared.wire.schemas import MissionId, SensorId

_MAX_BYTES = 4_000_000
# Ports that brokers listen on by default.
_PORTS = {"mqtt": 1883, "mqtts": 8883}
# An ID in a topic: none of MQTT's separators and wildcards.
Name = Annotated[str, Field(pattern=r"^[^/+#@\s]{1,100}$")]
# A field of the decoded payload, as its decoder calls it; dots lead into objects and lists (`sensors.0.level`).
FieldName = Annotated[str, Field(min_length=1, max_length=200)]


class ConfigurationError(Exception):
    """The file cannot be used; the message names the file and the field."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Broker(_Table):
    """``[broker]``: the address, the user, and the files for TLS, relative to this file."""

    url: str
    user: str | None = None
    ca_file: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    client_id: Annotated[str, Field(pattern=r"^[0-9A-Za-z_-]{1,64}$")] = "aicvds"

    @field_validator("url")
    @classmethod
    def _address(cls, url: str) -> str:
        wrong = "must be mqtt://host or mqtts://host (TLS), with a port from 1 to 65535 if it is not the usual one"
        try:
            parsed = urlsplit(url)
            port, _ = parsed.port, (parsed.hostname or "").encode("idna")
        except ValueError:
            raise ValueError(wrong) from None
        plain = parsed.hostname and "@" not in url and not (parsed.path or parsed.query or parsed.fragment)
        if parsed.scheme not in _PORTS or not plain or port == 0:
            raise ValueError(wrong)
        return url

    @model_validator(mode="after")
    def _tls_files(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both")
        if not self.encrypted and (self.ca_file or self.certificate):
            raise ValueError("ca_file, certificate and key are for TLS: write url as mqtts://")
        return self

    @property
    def encrypted(self) -> bool:
        """Whether the connection is by TLS."""
        return self.url.startswith("mqtts://")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        parsed = urlsplit(self.url)
        return parsed.hostname or "", parsed.port or _PORTS[parsed.scheme]


class Network(_Table):
    """``[network]``: the network server, and the tenant and application whose uplinks count."""

    server: Literal["chirpstack", "the-things-stack"]
    application: Name
    tenant: Name | None = None
    max_age_s: float = Field(3600.0, gt=0, le=86_400)

    @property
    def topics(self) -> list[str]:
        """The MQTT topics of the application's uplinks."""
        if self.server == "chirpstack":
            return [f"application/{self.application}/device/+/event/{event}" for event in ("up", "status")]
        tenant = f"@{self.tenant}" if self.tenant else ""
        return [f"v3/{self.application}{tenant}/devices/+/up"]


class Payload(_Table):
    """``[payload]``: the fields that the network server's decoder makes of a device's bytes."""

    queue: FieldName
    packets_per_unit: float = Field(1.0, gt=0, le=1e6)
    battery: FieldName | None = None
    battery_full_j: float | None = Field(None, gt=0, le=1e9)

    @model_validator(mode="after")
    def _battery_scale(self) -> Self:
        if self.battery is not None and self.battery_full_j is None:
            raise ValueError(
                "battery_full_j is missing: the joules of a full battery, which `battery` is a percentage of"
            )
        return self


class Device(_Table):
    """One of ``[[device]]``: a device's EUI, and the sensor of the mission that it is."""

    dev_eui: Annotated[str, Field(pattern=r"^[0-9A-Fa-f]{16}$")]
    sensor_id: SensorId
    mission: MissionId | None = None


class Configuration(_Table):
    """The whole file; ``mission`` is that of the devices that name none."""

    broker: Broker
    network: Network
    payload: Payload
    mission: MissionId = "default"
    device: Annotated[list[Device], Field(min_length=1, max_length=100_000)]

    @model_validator(mode="after")
    def _one_device_a_sensor(self) -> Self:
        for what, names in (
            ("device", Counter(device.dev_eui.lower() for device in self.device)),
            ("sensor", Counter(f"{device.sensor_id} of {self.mission_of(device)}" for device in self.device)),
        ):
            if (twice := names.most_common(1)[0])[1] > 1:
                raise ValueError(f"device: {what} {twice[0]} appears more than once")
        return self

    def mission_of(self, device: Device) -> str:
        """The mission of a device."""
        return device.mission or self.mission


def read_configuration(path: Path, broker_url: str | None = None) -> Configuration:
    """Read the file; the paths in it become absolute.

    Args:
        broker_url: instead of the file's.

    Raises:
        ConfigurationError: the file or one that it names cannot be read, or a field is wrong.
    """
    text = text_of(path, _MAX_BYTES, ConfigurationError)
    try:
        found = Configuration.model_validate(_with_broker(tomllib.loads(text), broker_url))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
        known = [name for table in (Broker, Network, Payload, Device, Configuration) for name in table.model_fields]
        problem = problem_of(first, known).replace("a JSON object", "a table")
        raise ConfigurationError(f"{path}: {field}{': ' if field else ''}{problem}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path} is no TOML: {' '.join(str(error).split())}") from None
    files: dict[str, Path] = {}
    for name in ("ca_file", "certificate", "key"):
        if (given := getattr(found.broker, name)) is not None:
            files[name] = path.parent.absolute() / given.expanduser()
            if not files[name].is_file():
                raise ConfigurationError(f"{path}: broker.{name}: there is no file {files[name]}")
    return found.model_copy(update={"broker": found.broker.model_copy(update=files)})


def _with_broker(document: dict[str, Any], url: str | None) -> dict[str, Any]:
    if url is None or not isinstance(document.get("broker", {}), dict):
        return document
    return {**document, "broker": {**document.get("broker", {}), "url": url}}
