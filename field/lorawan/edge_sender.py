"""Readings sent to the edge: in batches by mission, retried while it is unavailable, dropped where it refuses them."""

import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime

import httpx

from field.lorawan.pending_readings import MqttMetrics, PendingReading, ReadingBuffer
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeError, EdgeProtocolError, EdgeRefused
from shared.wire.readings import MAX_AGE_S, ReadingResult, ReadingsRequest, SensorReading

log = logging.getLogger(__name__)

_TIMEOUT_S = 10.0
_BATCH_SIZE = 500
# The pause after a failure of the edge: the first, and the longest after doubling.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 30.0
# Answers to readings that the edge can never take.
_PERMANENT_STATUS = frozenset((400, 413, 415, 422))


class EdgeSender:
    """Sends the buffered readings to an edge; one thread uses it.

    Args:
        edge: base URL.
        key: an API key with the scope ``readings``, if the edge needs one.
        retry_s: pause before readings of a mission that is unknown or has not begun are sent again.
    """

    def __init__(
        self,
        edge: str,
        key: str | None,
        pending: ReadingBuffer,
        metrics: MqttMetrics,
        transport: httpx.BaseTransport | None = None,
        retry_s: float = 5.0,
    ) -> None:
        # No retry: its readings would be old by then, and the next call sends the newest ones.
        self._client = EdgeClient(edge, timeout_s=_TIMEOUT_S, attempts=1, api_key=key, transport=transport)
        self._pending = pending
        self._metrics = metrics
        self._retry_s = retry_s
        self._retry_at: dict[str, float] = {}
        self._pause_s = 0.0
        self._reported_sensors: set[str] = set()

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def send_pending(self) -> float:
        """Send all buffered readings once; returns the seconds to wait before the next call."""
        now, due = time.monotonic(), self._pending.drain()
        try:
            while due:
                mission_id, readings = next(iter(due.items()))
                if self._retry_at.get(mission_id, 0.0) > now:
                    self._pending.put_back(readings)
                else:
                    for start in range(0, len(readings), _BATCH_SIZE):
                        self._send(mission_id, readings[start : start + _BATCH_SIZE])
                    self._pause_s = 0.0
                del due[mission_id]
        except EdgeError as error:
            # The edge counts those that it already has as duplicates. The mission that failed is the next call's last.
            for unsent in (*list(due.values())[1:], due[mission_id]):
                self._pending.put_back(unsent)
            self._metrics.failures.inc()
            self._pause_s = min(max(_FIRST_PAUSE_S, 2 * self._pause_s), _LONGEST_PAUSE_S)
            log.warning("the edge takes no readings, the next attempt is in %g s: %s", self._pause_s, error)
            return self._pause_s
        return _FIRST_PAUSE_S

    def _send(self, mission_id: str, readings: Sequence[PendingReading]) -> None:
        """Send readings of one mission, in halves where the edge refuses them together; raises ``EdgeError``."""
        body = ReadingsRequest(readings=[_to_wire(reading) for reading in readings])
        try:
            answer = self._client.send_readings(mission_id, body)
        except EdgeRefused as refused:
            # 409: the edge cannot load the mission from its store; only deleting the mission cures that.
            if refused.status in (404, 409):
                level = logging.DEBUG if mission_id in self._retry_at else logging.WARNING
                log.log(level, "the readings of mission %s wait: %s", mission_id, refused.detail)
                self._put_back(mission_id, readings, "no_mission")
            elif refused.status not in _PERMANENT_STATUS:
                raise
            elif len(readings) == 1:
                self._count_refused(readings[0], refused)
            else:
                for half in (readings[: len(readings) // 2], readings[len(readings) // 2 :]):
                    self._send(mission_id, half)
        else:
            self._count_results(mission_id, readings, answer.results)

    def _count_results(
        self, mission_id: str, readings: Sequence[PendingReading], results: Sequence[ReadingResult]
    ) -> None:
        if len(results) != len(readings):
            raise EdgeProtocolError("the answer has no result for each reading: is that an AIC-VDS edge?")
        early, now = list[PendingReading](), datetime.now(UTC)
        for reading, result in zip(readings, results, strict=True):
            if result == "early":
                early.append(reading)
                continue
            self._metrics.readings.labels(result).inc()
            self._metrics.age_s.observe(max(0.0, (now - reading.at).total_seconds()))
        if early:
            self._put_back(mission_id, early, "early")

    def _put_back(self, mission_id: str, readings: Sequence[PendingReading], why: str) -> None:
        """Buffer readings of a mission that does not exist yet or has not begun; newer ones replace them."""
        self._metrics.readings.labels(why).inc(len(readings))
        self._retry_at[mission_id] = time.monotonic() + self._retry_s
        self._pending.put_back(list(readings))

    def _count_refused(self, reading: PendingReading, refused: EdgeRefused) -> None:
        self._metrics.readings.labels("refused").inc()
        sensor = f"sensor {reading.sensor_id} of mission {reading.mission_id}"
        # A wrong mapping refuses every reading of its sensor; its first line in the log is enough.
        if sensor not in self._reported_sensors:
            self._reported_sensors.add(sensor)
            log.warning("%s: the edge refuses its readings: %s", sensor, refused.detail)


def _to_wire(reading: PendingReading) -> SensorReading:
    return SensorReading(
        sensor_id=reading.sensor_id,
        # A full queue times a unit that is no binary fraction is a little more than the capacity.
        queue=min(round(reading.queue, 6), 100_000.0),
        battery=reading.battery,
        age_s=min(max(0.0, (datetime.now(UTC) - reading.at).total_seconds()), MAX_AGE_S),
        message_id=reading.message_id,
    )
