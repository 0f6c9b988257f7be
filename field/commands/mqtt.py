"""``aicvds mqtt``: readings of LoRaWAN sensors, from an MQTT broker to an edge."""

import logging
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from field.lorawan.configuration import Configuration

_PASSWORD, _API_KEY = "AICVDS_MQTT_PASSWORD", "AICVDS_API_KEY"


@dataclass(frozen=True)
class Mqtt:
    """Forward LoRaWAN sensors' readings from an MQTT broker to an edge.

    Subscribes to the uplinks of ChirpStack v4 or The Things Stack, and sends each sensor's newest queue and battery to
    the edge, which merges them into its mission's belief by their age. FILE says which device is which sensor: see
    docs/guides/lorawan.md, and examples/lorawan/lorawan.toml to begin with.

    The environment variable AICVDS_MQTT_PASSWORD has the broker user's password, and AICVDS_API_KEY a key of the edge
    with the scope `readings`. Ends by SIGTERM, SIGHUP or Ctrl-C. Exit code: 0 ended, 2 bad use.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE")]]
    """The broker, the network's names, the payload's fields and the devices, in TOML."""
    edge: Annotated[str, arg(metavar="URL")] = "http://127.0.0.1:8000"
    """The edge's address."""
    broker: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The broker's address, instead of the one in FILE."""
    check: Annotated[Literal["on", "off"], arg(metavar="on|off")] = "off"
    """on: read FILE, print what it means, and end."""
    metrics_port: Annotated[int, arg(metavar="0-65535")] = 0
    """Port of this process's metrics for Prometheus; 0: none."""
    metrics_host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address for that port; 0.0.0.0 for every interface. The metrics need no key."""
    log_level: Annotated[Literal["debug", "info", "warning"], arg(metavar="LEVEL")] = "info"
    """debug: a line for every message; info; warning."""


def main(argv: list[str]) -> int:
    """Forward until SIGTERM or Ctrl-C; returns the exit code."""
    options = tyro.cli(Mqtt, prog="aicvds mqtt", args=argv)
    from field.lorawan.configuration import ConfigurationError, read_configuration

    try:
        configuration = read_configuration(options.file, options.broker)
    except ConfigurationError as error:
        return _refused(str(error))
    if options.check == "on":
        print(_in_words(configuration))
        return 0
    from shared.client.retries_and_redirects import edge_url

    try:
        edge_url(options.edge)
    except ValueError as error:
        return _refused(f"--edge: {error}")
    if not 0 <= options.metrics_port <= 65535:
        return _refused(f"--metrics-port {options.metrics_port} is not between 0 and 65535")
    level = getattr(logging, options.log_level.upper())
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)-7s %(message)s", stream=sys.stderr)
    logging.getLogger("field.lorawan").setLevel(level)
    return _forward(configuration, options)


def _forward(configuration: "Configuration", options: Mqtt) -> int:
    from prometheus_client import start_http_server

    from field.lorawan.edge_sender import EdgeSender
    from field.lorawan.pending_readings import MqttMetrics, ReadingBuffer
    from field.lorawan.subscription import Subscription

    metrics = MqttMetrics()
    pending = ReadingBuffer(configuration, metrics)
    try:
        subscription = Subscription(configuration, os.environ.get(_PASSWORD) or None, pending, metrics)
    except OSError as error:
        return _refused(f"{options.file}: broker: ca_file, certificate or key: {error}")
    if options.metrics_port:
        try:
            start_http_server(options.metrics_port, options.metrics_host, metrics.registry)
        except OSError as error:
            return _refused(f"--metrics-port {options.metrics_port}: {error.strerror or error}")
    sender = EdgeSender(options.edge.rstrip("/"), os.environ.get(_API_KEY) or None, pending, metrics)
    ended = threading.Event()
    for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(each) != signal.SIG_IGN:
            signal.signal(each, lambda *_: ended.set())
    subscription.start()
    print(f"aicvds mqtt: {_in_words(configuration)}", file=sys.stderr, flush=True)
    pause_s = 0.0
    while not ended.wait(pause_s):
        pause_s = sender.send_pending()
    subscription.stop()
    sender.send_pending()
    sender.close()
    return 0


def _in_words(configuration: "Configuration") -> str:
    missions = sorted({configuration.mission_of(device) for device in configuration.device})
    shown = ", ".join(missions[:5]) + (f" and {len(missions) - 5} more" if len(missions) > 5 else "")
    network = configuration.network
    return (
        f"{len(configuration.device)} devices of {network.server}, application {network.application}, are sensors of "
        f"{shown}; broker {configuration.broker.url}, topics {', '.join(network.topics)}"
    )


def _refused(fault: str) -> int:
    print(f"aicvds mqtt: {fault}", file=sys.stderr)
    return 2
