"""``aicvds mqtt`` between a real mosquitto and a real edge: TLS, passwords, a broker that is killed."""

from __future__ import annotations

import json
import shutil
import signal
import ssl
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme
from paho.mqtt import publish

from tests.support.edge_stub import free_port
from tests.support.lorawan_messages import APPLICATION, TENANT, chirpstack_up, dev_eui, the_things_stack_up
from tests.support.processes import output_until, run, started
from tests.support.waiting import PATIENCE_S, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
Message = Callable[..., dict[str, Any]]

pytestmark = pytest.mark.needs("mosquitto")
USER, PASSWORD = "aicvds", "grün-7"


class Broker:
    """A mosquitto on a port of its own; ``lines`` are more of its configuration."""

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        self._config.write_text("\n".join((f"listener {self.port} 127.0.0.1", *lines, "")))
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        # As root it would become another user, who cannot read the test's files.
        self._process = subprocess.Popen([program, "-c", self._config], stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait(PATIENCE_S)

    def publish(self, topic: str, message: object, **more: Any) -> None:
        payload = message if isinstance(message, bytes) else json.dumps(message)
        publish.single(topic, payload, qos=1, hostname="127.0.0.1", port=self.port, **more)


@contextmanager
def broker(folder: Path, *lines: str) -> Iterator[Broker]:
    running = Broker(folder, *lines)
    running.start()
    try:
        yield running
    finally:
        running.kill()


def file(folder: Path, port: int, server: str = "chirpstack", scheme: str = "mqtt", more: str = "") -> Path:
    """A configuration of three devices, sensors 10 to 12."""
    things = server == "the-things-stack"
    devices = "".join(f'[[device]]\ndev_eui = "{dev_eui(number)}"\nsensor_id = {10 + number}\n' for number in range(3))
    path = folder / "lorawan.toml"
    path.write_text(
        f'mission = "wide"\n[broker]\nurl = "{scheme}://localhost:{port}"\n{more}\n'
        f'[network]\nserver = "{server}"\napplication = "{"pipeline" if things else APPLICATION}"\n'
        f'tenant = "{"ttn" if things else TENANT}"\n'
        f'[payload]\nqueue = "{"level.queue" if things else "queue"}"\nbattery_full_j = 50\n{devices}'
    )
    return path


@pytest.fixture
def wide(edge: Edge, report: Report) -> httpx.Client:
    """An edge with a mission of 20 sensors, of which its UAV has heard four."""
    client = edge()
    client.put("/missions/wide", json={"scenario": {"name": "wide", "sensors": 20}})
    assert client.post("/decide", json=report(mission_id="wide")).status_code == 200
    return client


def merged(client: httpx.Client) -> int:
    return int(client.get("/missions/wide").json().get("readings", 0))


def numbers(port: int) -> dict[str, float]:
    """The process's numbers by series."""
    text = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S, trust_env=False).text
    lines = (line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    return {series: float(number) for series, number in lines}


def ago(seconds: float) -> datetime:
    return datetime.now(UTC) - timedelta(seconds=seconds)


TOPICS = {
    "chirpstack": f"application/{APPLICATION}/device/{{}}/event/up",
    "the-things-stack": "v3/pipeline@ttn/devices/{}/up",
}


@pytest.mark.parametrize(
    ("server", "message", "end"),
    [("chirpstack", chirpstack_up, signal.SIGTERM), ("the-things-stack", the_things_stack_up, signal.SIGHUP)],
)
def test_uplinks_reach_the_mission(
    tmp_path: Path, wide: httpx.Client, server: str, message: Message, end: signal.Signals
) -> None:
    metrics = free_port()
    with ExitStack() as stack:
        there = stack.enter_context(broker(tmp_path, "allow_anonymous true"))
        command = ("mqtt", str(file(tmp_path, there.port, server)), "--edge", str(wide.base_url))
        process = stack.enter_context(started(*command, "--metrics-port", str(metrics)))
        output_until(process, "subscribed at")
        topic = TOPICS[server].format
        there.publish(topic("kp-0"), message(device=0, queue=33, at=ago(95)))
        there.publish(topic("kp-1"), message(device=1, queue=8, at=ago(35)))
        until(lambda: merged(wide) == 2)
        for payload in (
            message(device=1, queue=8, at=ago(35), f_cnt=0),
            message(device=7, at=ago(1)),
            message(device=0, queue="full", at=ago(1)),
            b"{",
        ):
            there.publish(topic("kp-2"), payload)
        there.publish("application/other/device/x/event/up", message(device=2))
        there.publish(topic("kp-2"), message(device=2, queue=60, at=ago(0)))
        until(lambda: numbers(metrics).get('aicvds_mqtt_readings_total{result="merged"}') == 3 or merged(wide) == 3)
        until(lambda: numbers(metrics).get('aicvds_mqtt_uplinks_total{result="accepted"}') == 4)
        reported = numbers(metrics)
        for result in ("unknown_device", "no_queue", "unreadable"):
            assert reported[f'aicvds_mqtt_uplinks_total{{result="{result}"}}'] == 1
        assert reported["aicvds_mqtt_connected"] == 1
        process.send_signal(end)
        assert process.wait(PATIENCE_S) == 0


def test_tls_with_a_clients_certificate_and_a_password(tmp_path: Path, wide: httpx.Client) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.crt")
    served, client = authority.issue_cert("localhost", "127.0.0.1"), authority.issue_cert("aicvds@example.org")
    for name, cert in (("server", served), ("client", client)):
        cert.cert_chain_pems[0].write_to_path(tmp_path / f"{name}.crt")
        cert.private_key_pem.write_to_path(tmp_path / f"{name}.key")
    passwords = tmp_path / "passwords"
    passwords.touch(0o600)
    subprocess.run(["mosquitto_passwd", "-b", str(passwords), USER, PASSWORD], check=True, capture_output=True)
    for path in tmp_path.iterdir():
        path.chmod(0o644)
    tmp_path.chmod(0o755)
    lines = (
        "user root",
        f"password_file {passwords}",
        f"cafile {tmp_path / 'ca.crt'}",
        f"certfile {tmp_path / 'server.crt'}",
        f"keyfile {tmp_path / 'server.key'}",
        "require_certificate true",
    )
    tls: Any = {"ca_certs": str(tmp_path / "ca.crt"), "certfile": str(tmp_path / "client.crt")}
    tls |= {"keyfile": str(tmp_path / "client.key"), "tls_version": ssl.PROTOCOL_TLS_CLIENT}
    with broker(tmp_path, *lines) as there:
        more = f'user = "{USER}"\nca_file = "ca.crt"\ncertificate = "client.crt"\nkey = "client.key"'
        path = file(tmp_path, there.port, scheme="mqtts", more=more)
        command = ("mqtt", str(path), "--edge", str(wide.base_url))
        with started(*command, AICVDS_MQTT_PASSWORD="wrong") as process:
            output_until(process, "refuses the connection: Not authorized")
        with started(*command, AICVDS_MQTT_PASSWORD=PASSWORD) as process:
            output_until(process, "subscribed at")
            auth: Any = {"username": USER, "password": PASSWORD}
            there.publish(TOPICS["chirpstack"].format("kp-0"), chirpstack_up(at=ago(40)), auth=auth, tls=tls)
            until(lambda: merged(wide) == 1)
        # Of an authority that the system does not know.
        path.write_text(path.read_text().replace('ca_file = "ca.crt"\n', ""))
        with started(*command, AICVDS_MQTT_PASSWORD=PASSWORD) as process:
            output_until(process, "cannot be reached")


def test_a_broker_that_is_killed_is_found_again(tmp_path: Path, wide: httpx.Client) -> None:
    with broker(tmp_path, "allow_anonymous true") as there:
        path = file(tmp_path, there.port)
        with started("mqtt", str(path), "--edge", str(wide.base_url)) as process:
            output_until(process, "subscribed at")
            there.publish(TOPICS["chirpstack"].format("kp-0"), chirpstack_up(at=ago(60)))
            until(lambda: merged(wide) == 1)
            there.kill()
            output_until(process, "is lost")
            there.start()
            output_until(process, "subscribed at")
            there.publish(TOPICS["chirpstack"].format("kp-1"), chirpstack_up(device=1, at=ago(30)))
            until(lambda: merged(wide) == 2)


def test_what_is_wrong_is_named_before_anything_starts(tmp_path: Path) -> None:
    path = file(tmp_path, 1883)
    assert "3 devices of chirpstack" in run("mqtt", str(path), "--check", "on").stdout
    path.write_text(path.read_text().replace("sensor_id = 11", "sensor_id = 10"))
    refused = run("mqtt", str(path))
    assert refused.returncode == 2
    assert refused.stderr.strip().endswith("lorawan.toml: device: sensor 10 of wide appears more than once")


def test_an_edge_that_is_killed_has_what_it_merged_and_gets_what_came_meanwhile(tmp_path: Path, report: Report) -> None:
    port, store = free_port(), tmp_path / "missions.db"
    served = ("serve", "--port", str(port), "--mode", "policy", "--store", str(store))
    url = f"http://127.0.0.1:{port}"
    with ExitStack() as stack:
        there = stack.enter_context(broker(tmp_path, "allow_anonymous true"))
        client = stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S, trust_env=False))
        forwarding = stack.enter_context(started("mqtt", str(file(tmp_path, there.port)), "--edge", url))
        output_until(forwarding, "subscribed at")
        topic = TOPICS["chirpstack"].format("kp-0")
        with started(*served, AICVDS_PLANNER="off") as edge:
            output_until(edge, "listening on")
            client.put("/missions/wide", json={"scenario": {"name": "wide", "sensors": 20}})
            client.post("/decide", json=report(mission_id="wide"))
            there.publish(topic, chirpstack_up(queue=41, at=ago(95)))
            until(lambda: merged(client) == 1)
            edge.kill()
        there.publish(topic, chirpstack_up(queue=44, f_cnt=2, at=ago(65)))
        there.publish(topic, chirpstack_up(queue=47, f_cnt=3, at=ago(35)))
        output_until(forwarding, "takes no readings")
        with started(*served, AICVDS_PLANNER="off") as edge:
            output_until(edge, "listening on")
            # One from before, and of the two that came meanwhile the newer one.
            until(lambda: merged(client) == 2)
