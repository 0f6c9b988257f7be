"""Prometheus metrics of a running flight. To bound their cardinality, no label has a mission, UAV or sensor."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, make_wsgi_app
from prometheus_client.process_collector import ProcessCollector

from simulator.errors import UsageError

if TYPE_CHECKING:
    from simulator.flying.pilots import PilotChoice
    from simulator.records.flight import Flight

LONGEST_LAST_SCRAPE_S = 20.0
_ROUND_TRIP_BUCKETS = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2, 3, 5, 10, 30, 60)


class FlightMetrics:
    """The metrics of one flight, in a separate registry.

    Args:
        steps: of the mission.
    """

    def __init__(self, steps: int) -> None:
        self.registry = r = CollectorRegistry()
        ProcessCollector(registry=r)
        self._decisions = Counter("aicvds_flight_decisions", "Decisions flown", ["source", "reason"], registry=r)
        self._round_trip = Histogram(
            "aicvds_flight_round_trip_seconds",
            "Time from a UAV's first attempt to the edge's answer, retries included",
            registry=r,
            buckets=_ROUND_TRIP_BUCKETS,
        )
        self._lost = Counter("aicvds_flight_lost_packets", "Packets that full queues lost", registry=r)
        self._overflows = Counter("aicvds_flight_overflows", "Queues that overflowed, each step anew", registry=r)
        self._collected = Counter("aicvds_flight_collected_packets", "Packets that UAVs collected", registry=r)
        self._failed = Counter("aicvds_flight_failed_transmissions", "Transmissions that failed", registry=r)
        self._flown = Gauge("aicvds_flight_steps_flown", "Steps that the whole fleet has flown", registry=r)
        Gauge("aicvds_flight_steps", "Steps that the mission has", registry=r).set(steps)

    def count_decision(self, choice: PilotChoice) -> None:
        """Count one decision."""
        self._decisions.labels(choice.source, choice.reason or "none").inc()
        if choice.exchange is not None:
            self._round_trip.observe(choice.exchange.rtt_ms / 1e3)

    def count_step(self, flight: Flight) -> None:
        """Count one step of the whole fleet."""
        tally = flight.tally[-1]
        self._lost.inc(tally.lost_packets)
        self._overflows.inc(tally.overflows)
        self._collected.inc(float(tally.collected.sum()))
        self._failed.inc(tally.failures)
        self._flown.set(flight.steps_flown)


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    # Seconds until a silent connection is closed.
    timeout = 10

    def log_message(self, format: str, *args: object) -> None:
        """Log no scrape."""


class _CountedBody:
    """A response body that calls ``on_sent`` after its last byte, when the server closes it."""

    def __init__(self, body: Iterable[bytes], on_sent: Callable[[], None]) -> None:
        self._body = body
        self.close = on_sent

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._body)


class MetricsServer:
    """An HTTP server in a thread that answers Prometheus and counts the scrapes.

    Raises:
        UsageError: the address is unusable or in use.
    """

    def __init__(self, registry: CollectorRegistry, host: str, port: int) -> None:
        self._app = make_wsgi_app(registry)
        self._scrapes = 0
        self._scraped = threading.Condition()
        try:
            self._server = make_server(host, port, self._answer, server_class=_Server, handler_class=_Quiet)
        except OSError as error:
            raise UsageError(
                f"--metrics-port {port} on {host}: {error.strerror}; choose another, or 0 for none"
            ) from None
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port on which it listens."""
        return self._server.server_port

    def _answer(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        return _CountedBody(self._app(environ, start_response), self._count)

    def _count(self) -> None:
        with self._scraped:
            self._scrapes += 1
            self._scraped.notify_all()

    def await_last_scrape(self) -> None:
        """Wait for one more scrape, if there was any, so that Prometheus has the flight's final numbers."""
        deadline = time.monotonic() + LONGEST_LAST_SCRAPE_S
        with self._scraped:
            before = self._scrapes
            while before and self._scrapes == before and (remaining_s := deadline - time.monotonic()) > 0:
                self._scraped.wait(remaining_s)

    def close(self) -> None:
        """Stop the server and its thread."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@contextmanager
def serve_metrics(metrics: FlightMetrics, host: str, port: int) -> Iterator[MetricsServer | None]:
    """Within the context, serve the metrics to Prometheus; port 0 serves none.

    Raises:
        UsageError: the address is unusable or in use.
    """
    if port == 0:
        yield None
        return
    server = MetricsServer(metrics.registry, host, port)
    try:
        yield server
    finally:
        server.close()
