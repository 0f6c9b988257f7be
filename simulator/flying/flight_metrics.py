"""Prometheus metrics of a running flight. To bound their cardinality, no label has a mission, UAV or sensor."""

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server
from prometheus_client.core import Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from simulator.errors import UsageError

if TYPE_CHECKING:
    from simulator.flying.pilots import PilotChoice
    from simulator.records.flight import Flight

LONGEST_LAST_SCRAPE_S = 20.0
# From the reading of the last numbers to the end of their answer.
_ANSWER_S = 0.3
_ROUND_TRIP_BUCKETS = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2, 3, 5, 10, 30, 60)


class FlightMetrics:
    """The metrics of one flight of so many ``steps``, in a separate registry."""

    def __init__(self, steps: int) -> None:
        self.registry = r = CollectorRegistry()
        ProcessCollector(registry=r)
        self._decisions = Counter("aicvds_flight_decisions", "Decisions flown", ["source", "reason"], registry=r)
        text = "Time from a UAV's first attempt to the edge's answer, retries included"
        self._round_trip = Histogram("aicvds_flight_round_trip_seconds", text, registry=r, buckets=_ROUND_TRIP_BUCKETS)
        self._lost = Counter("aicvds_flight_lost_packets", "Packets that full queues lost", registry=r)
        self._overflows = Counter("aicvds_flight_overflows", "Queues that overflowed, each step anew", registry=r)
        self._collected = Counter("aicvds_flight_collected_packets", "Packets that UAVs collected", registry=r)
        self._failed = Counter("aicvds_flight_failed_transmissions", "Transmissions that failed", registry=r)
        self._flown = Gauge("aicvds_flight_steps_flown", "Steps that the whole fleet has flown", registry=r)
        Gauge("aicvds_flight_steps", "Steps that the mission has", registry=r).set(steps)

    def count_decision(self, choice: "PilotChoice") -> None:
        """Count one decision."""
        self._decisions.labels(choice.source, choice.reason or "none").inc()
        if choice.exchange is not None:
            self._round_trip.observe(choice.exchange.rtt_ms / 1e3)

    def count_step(self, flight: "Flight") -> None:
        """Count one step of the whole fleet."""
        tally = flight.tally[-1]
        self._lost.inc(tally.lost_packets)
        self._overflows.inc(tally.overflows)
        self._collected.inc(float(tally.collected.sum()))
        self._failed.inc(tally.failures)
        self._flown.set(flight.steps_flown)


class Scrapes(Collector):
    """Counts the scrapes of a registry, and has no numbers of its own."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._scraped, self._any = threading.Event(), False
        registry.register(self)

    def collect(self) -> Iterable[Metric]:
        """Note a scrape."""
        self._any = True
        self._scraped.set()
        return ()

    def await_last(self) -> None:
        """Wait for one more scrape, if there was any, so that Prometheus has the flight's final numbers."""
        self._scraped.clear()
        if self._any and self._scraped.wait(LONGEST_LAST_SCRAPE_S):
            time.sleep(_ANSWER_S)


@contextmanager
def serve_metrics(metrics: FlightMetrics, host: str, port: int) -> Iterator[Scrapes | None]:
    """Within the context, serve the metrics to Prometheus; port 0 serves none.

    Raises:
        UsageError: the address is unusable or in use.
    """
    if port == 0:
        yield None
        return
    scrapes = Scrapes(metrics.registry)
    try:
        server, _ = start_http_server(port, host, metrics.registry)
    except OSError as error:
        raise UsageError(f"--metrics-port {port} on {host}: {error.strerror}; choose another, or 0 for none") from None
    try:
        yield scrapes
    finally:
        server.shutdown()
        server.server_close()
