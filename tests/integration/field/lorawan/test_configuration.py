"""The file that says which device is which sensor: what is wrong in it is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from field.commands import mqtt
from field.lorawan.configuration import Configuration, ConfigurationError, read_configuration
from tests.support.places import ROOT

EXAMPLE = ROOT / "examples" / "lorawan" / "lorawan.toml"
TEXT = EXAMPLE.read_text()


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "lorawan.toml"
    path.write_text(text)
    return path


def read(tmp_path: Path, *replaced: tuple[str, str]) -> Configuration:
    text = TEXT
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new, 1)
    return read_configuration(written(tmp_path, text))


def test_the_example_is_read() -> None:
    found = read_configuration(EXAMPLE)
    assert found.broker.address == ("localhost", 1883)
    assert [found.mission_of(device) for device in found.device] == ["patrol", "patrol", "patrol-north"]
    assert found.network.topics == [
        f"application/{found.network.application}/device/+/event/{event}" for event in ("up", "status")
    ]


@pytest.mark.parametrize(
    ("tenant", "topic"), [('tenant = "ttn"', "v3/app1@ttn/devices/+/up"), ("", "v3/app1/devices/+/up")]
)
def test_the_things_stack_has_a_tenant_in_its_topics_except_the_open_source_one(
    tmp_path: Path, tenant: str, topic: str
) -> None:
    found = read(
        tmp_path,
        ('"chirpstack"', '"the-things-stack"'),
        ('application = "ae5ba7f1-53a6-4f0e-9f3b-6f1f3a7c2b10"', 'application = "app1"'),
        ('tenant = "52f14cd4-c6f1-4fbd-8f87-4025e1d49242"', tenant),
    )
    assert found.network.topics == [topic]


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("mqtt://broker:1884", ("broker", 1884)),
        ("mqtts://broker.example", ("broker.example", 8883)),
        ("mqtts://[::1]", ("::1", 8883)),
        ("mqtt://[::1]:1884", ("::1", 1884)),
    ],
)
def test_an_address_has_the_usual_port_unless_it_names_one(tmp_path: Path, url: str, address: tuple[str, int]) -> None:
    assert read(tmp_path, ("mqtt://localhost", url)).broker.address == address


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("mqtt://localhost", "http://localhost", "broker.url: must be mqtt://host"),
        ("mqtt://localhost", "mqtt://me:secret@localhost", "broker.url: must be mqtt://host"),
        ("mqtt://localhost", "mqtt://localhost:70000", "broker.url: must be mqtt://host"),
        ("mqtt://localhost", "mqtt://broker..example", "broker.url: must be mqtt://host"),
        ("mqtt://localhost", f"mqtt://{'b' * 64}.example", "broker.url: must be mqtt://host"),
        ('"chirpstack"', '"chirp"', "network.server: "),
        ('application = "ae', 'application = "+/ae', "network.application: "),
        ('queue = "queue"', 'queue = ""', "payload.queue: "),
        ('queue = "queue"', 'queues = "queue"', "payload.queue: is missing"),
        ("battery_full_j = 50", 'battery = "b"', "payload: battery_full_j is missing"),
        ("battery_full_j = 50", "battery_full_j = nan", "payload.battery_full_j: "),
        ('"0004a30b001c0531"', '"0004a30b001c053"', "device[1].dev_eui: "),
        ('"0004a30b001c0531"', '"0004A30B001C0530"', "device: device 0004a30b001c0530 appears more than once"),
        ("sensor_id = 1", "sensor_id = 0", "device: sensor 0 of patrol appears more than once"),
        ("sensor_id = 1", "sensor_id = -1", "device[1].sensor_id: "),
        ("sensor_id = 1", "sensor = 1", "device[1].sensor_id: is missing"),
        ('mission = "patrol"', 'mission = "pa trol"', "mission: "),
        ('mission = "patrol"', 'misson = "patrol"', "misson: there is no such field; did you mean mission?"),
        ("# ca_file", "ca_file", "broker: ca_file, certificate and key are for TLS"),
        ('url = "mqtt://', 'certificate = "c"\nurl = "mqtts://', "broker: certificate and key belong together"),
        ('url = "mqtt://', 'ca_file = "none.pem"\nurl = "mqtts://', "broker.ca_file: there is no file "),
        ("[[device]]", "[[device]", "is no TOML: "),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        read(tmp_path, (old, new))
    assert str(error.value).startswith(str(tmp_path / "lorawan.toml"))
    assert named in str(error.value)


def test_files_for_tls_are_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "ca.crt").write_text("")
    found = read(tmp_path, ('url = "mqtt://localhost"', 'url = "mqtts://localhost"\nca_file = "ca.crt"'))
    assert found.broker.ca_file == tmp_path / "ca.crt"


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_a_file_of_another_system_is_read_the_same(tmp_path: Path, mark: bytes, end: bytes) -> None:
    path = tmp_path / "lorawan.toml"
    path.write_bytes(mark + TEXT.encode().replace(b"\n", end))
    assert read_configuration(path) == read_configuration(EXAMPLE)


def test_a_file_in_utf_16_is_named(tmp_path: Path) -> None:
    path = tmp_path / "lorawan.toml"
    path.write_bytes(TEXT.encode("utf-16"))
    with pytest.raises(ConfigurationError, match=r"lorawan\.toml, line 1: not UTF-8; save the file as UTF-8"):
        read_configuration(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"0004a30b001c0531"', '"xyz"', "device[1].dev_eui: must be 16 hexadecimal digits"),
        (
            'mission = "patrol"',
            'mission = "pa trol"',
            "mission: must be 1 to 64 letters, digits, `.`, `_` and `-`",
        ),
        ('application = "ae', 'application = "+/ae', "network.application: must be 1 to 100 characters without spaces"),
        (
            'url = "mqtt://',
            'client_id = "a b"\nurl = "mqtt://',
            "broker.client_id: must be 1 to 64 letters, digits",
        ),
        ("sensor_id = 1", "sensor_id = 1.5", "device[1].sensor_id: must be a valid integer"),
        ("battery_full_j = 50", "battery_full_j = 0", "payload.battery_full_j: must be greater than 0"),
        ("[broker]", "broker = 3\n[brokers]", "broker: must be a table"),
    ],
)
def test_a_fault_is_told_in_plain_words(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        read(tmp_path, (old, new))
    assert str(error.value).startswith(f"{tmp_path / 'lorawan.toml'}: {said}")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        read_configuration(tmp_path / "none.toml")


@pytest.mark.parametrize("edge", ["http://127.0.0.1:8000/?mission=m", "ftp://edge", "http://me:secret@edge", "edge"])
def test_an_edge_that_is_none_is_one_line(edge: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mqtt.main([str(EXAMPLE), "--edge", edge]) == 2
    error = capsys.readouterr().err
    assert "--edge: " in error and error.count("\n") == 1
