"""The subscription at an MQTT broker, which survives the broker's absence."""

import logging
from typing import Any

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from field.lorawan.configuration import Configuration
from field.lorawan.pending_readings import MqttMetrics, ReadingBuffer

log = logging.getLogger(__name__)

_KEEPALIVE_S = 30
# The pause before a reconnection: the first, and the longest after doubling.
_PAUSES_S = (1, 60)


class Subscription:
    """Adds every message of the network's topics to a buffer, in a separate thread.

    The broker keeps the session while this process is down, as far as its settings allow, and then delivers the uplinks
    of that time with their age. The thread reads a message only after it has processed the one before, so that a flood
    fills the network's queues and not the memory.

    Args:
        password: of the broker's user, if it has one.

    Raises:
        OSError: a file for TLS cannot be read. ``ssl.SSLError`` is one.
    """

    def __init__(
        self, configuration: Configuration, password: str | None, pending: ReadingBuffer, metrics: MqttMetrics
    ) -> None:
        broker = configuration.broker
        self._topics = configuration.network.topics
        self._broker = broker
        self._pending = pending
        self._metrics = metrics
        # The Things Stack speaks MQTT 3.1.1 only.
        self._client = Client(
            CallbackAPIVersion.VERSION2, client_id=broker.client_id, clean_session=False, protocol=MQTTv311
        )
        if broker.user is not None:
            self._client.username_pw_set(broker.user, password)
        if broker.encrypted:
            self._client.tls_set(
                ca_certs=None if broker.ca_file is None else str(broker.ca_file),
                certfile=None if broker.certificate is None else str(broker.certificate),
                keyfile=None if broker.key is None else str(broker.key),
            )
        self._client.reconnect_delay_set(*_PAUSES_S)
        self._client.on_connect = self._connected
        self._client.on_connect_fail = self._unreachable
        self._client.on_subscribe = self._subscribed
        self._client.on_disconnect = self._disconnected
        self._client.on_message = self._received

    def start(self) -> None:
        """Connect, and again whenever the connection is lost; returns at once."""
        host, port = self._broker.address
        self._client.connect_async(host, port, _KEEPALIVE_S)
        self._client.loop_start()

    def stop(self) -> None:
        """Disconnect, and end the thread."""
        self._client.disconnect()
        self._client.loop_stop()

    def _connected(
        self, client: Client, _: Any, flags: ConnectFlags, reason: ReasonCode, properties: Properties | None
    ) -> None:
        self._metrics.connects.labels("refused" if reason.is_failure else "connected").inc()
        if reason.is_failure:
            log.error("the broker %s refuses the connection: %s", self._broker.url, reason)
            return
        # Quality of service 1 where the broker has it: it repeats messages without an acknowledgement.
        client.subscribe([(topic, 1) for topic in self._topics])

    def _subscribed(
        self, client: Client, _: Any, number: int, reasons: list[ReasonCode], properties: Properties | None
    ) -> None:
        for topic, reason in zip(self._topics, reasons, strict=False):
            if reason.is_failure:
                log.error("the broker %s refuses the topic %s: %s", self._broker.url, topic, reason)
        if not all(reason.is_failure for reason in reasons):
            self._metrics.connected.set(1)
            log.info("subscribed at %s", self._broker.url)

    def _unreachable(self, client: Client, _: Any) -> None:
        self._metrics.connects.labels("unreachable").inc()
        log.warning("the broker %s cannot be reached; retrying", self._broker.url)

    def _disconnected(
        self, client: Client, _: Any, flags: DisconnectFlags, reason: ReasonCode, properties: Properties | None
    ) -> None:
        self._metrics.connected.set(0)
        if reason.is_failure:
            log.warning("the connection to %s is lost: %s; retrying", self._broker.url, reason)

    def _received(self, client: Client, _: Any, message: MQTTMessage) -> None:
        try:
            log.debug("%r: %s", message.topic, self._pending.add_message(bytes(message.payload), topic=message.topic))
        except Exception:
            # An error would end the client's thread, and no further message would come.
            log.exception("a message could not be processed")
