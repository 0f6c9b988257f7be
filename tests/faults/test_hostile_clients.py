"""Hundreds of clients that do not read, read or write a byte a second, or vanish, beside a fleet that flies."""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import psutil
import pytest

from service.api.live_routes import STATIC
from tests.faults.fleet import Report, ask, resident_mb
from tests.faults.table import Tables
from tests.support.processes import serving_edge
from tests.support.waiting import until

pytestmark = [pytest.mark.faults, pytest.mark.timeout(300)]

# More than the edge serves at a time, of each kind.
OF_A_KIND, REQUESTS = 100, 64
DEADLINE_MS, SLACK_MS = 1000, 50
# Longer than a client may take for its headers, or for 16 KB of an answer.
TAKEN_S, SECONDS = 35, 45.0
FILE, FILES = "vendor/uPlot.esm.js", 17
PIPELINED = f"GET /static/{FILE} HTTP/1.1\r\nhost: x\r\n\r\n".encode() * FILES
POST = b"POST /decide HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\ncontent-length: 1000\r\n\r\n"
# Closing with it resets the connection at once.
ABORT = struct.pack("ii", 1, 0)


class Client:
    """One hostile client after the other, each with a connection of its own, which the edge ends at last."""

    def __init__(self, address: tuple[str, int], kind: str, ended: Counter[str]) -> None:
        self._address, self._kind, self._ended = address, kind, ended

    async def run(self) -> None:
        """Go on until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            with socket.socket() as connection, suppress(ConnectionError):
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                await loop.sock_connect(connection, self._address)
                await getattr(self, f"_{self._kind}")(loop, connection)
            self._ended[self._kind] += 1
            await asyncio.sleep(1)

    async def _never_reading(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        await loop.sock_sendall(connection, PIPELINED)
        await asyncio.sleep(TAKEN_S)
        await self._cut_off(loop, connection)

    async def _reading_slowly(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        await loop.sock_sendall(connection, PIPELINED)
        for _ in range(TAKEN_S):
            await loop.sock_recv(connection, 1)
            await asyncio.sleep(1)
        await self._cut_off(loop, connection)

    async def _cut_off(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        """Check that the edge has ended the connection: what is left of its answers is no longer sent."""
        left = 0
        while received := await loop.sock_recv(connection, 65536):
            left += len(received)
        assert left < FILES * (STATIC / FILE).stat().st_size / 2

    async def _headers_slowly(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        await self._byte_by_byte(loop, connection, itertools.chain(POST[:-2], itertools.repeat(ord("x"))))

    async def _body_slowly(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        await loop.sock_sendall(connection, POST)
        await self._byte_by_byte(loop, connection, itertools.repeat(ord(" ")))

    async def _vanishing(self, loop: asyncio.AbstractEventLoop, connection: socket.socket) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, ABORT)
        await loop.sock_sendall(connection, PIPELINED)
        await loop.sock_recv(connection, 1)

    async def _byte_by_byte(
        self, loop: asyncio.AbstractEventLoop, connection: socket.socket, sent: Iterator[int]
    ) -> None:
        for byte in sent:
            await loop.sock_sendall(connection, bytes([byte]))
            with suppress(TimeoutError):
                async with asyncio.timeout(1):
                    while await loop.sock_recv(connection, 4096):
                        pass
                    return


KINDS = ("never_reading", "reading_slowly", "headers_slowly", "body_slowly", "vanishing")


@contextmanager
def hostile(url: str) -> Iterator[Counter[str]]:
    """500 of them at a time, from another thread; yields how many connections of each kind have ended."""
    parts = urlsplit(url)
    ended: Counter[str] = Counter()
    over = threading.Event()

    async def run() -> None:
        address = (parts.hostname or "", parts.port or 0)
        clients = [Client(address, kind, ended).run() for kind in KINDS for _ in range(OF_A_KIND)]
        running = [asyncio.create_task(client) for client in clients]
        while not over.is_set():
            await asyncio.sleep(0.1)
            for client in running:
                if client.done():
                    client.result()
        for client in running:
            client.cancel()
        await asyncio.gather(*running, return_exceptions=True)

    failed: list[BaseException] = []

    def thread() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:
            failed.append(error)

    clients = threading.Thread(target=thread, daemon=True)
    clients.start()
    try:
        yield ended
    finally:
        over.set()
        clients.join()
    assert failed == []


def test_clients_that_do_not_read_write_slowly_or_vanish(tmp_path: Path, report: Report, tables: Tables) -> None:
    settings = {"AICVDS_MODE": "value", "AICVDS_MAX_REQUESTS": str(REQUESTS), "AICVDS_STORE": str(tmp_path / "m.db")}
    with serving_edge(**settings) as (url, process):
        ask(url, report, 300, DEADLINE_MS)
        step = 100
        edge = psutil.Process(process.pid)
        files, memory = edge.num_fds(), resident_mb(process.pid)
        alone = ask(url, report, 600, DEADLINE_MS, first_step=step)
        with hostile(url) as ended:
            ends = time.monotonic() + SECONDS
            late = []
            while time.monotonic() < ends:
                step += 200
                late.append(ask(url, report, 600, DEADLINE_MS, first_step=step))
            connections = edge.num_fds() - files
            memory = resident_mb(process.pid) - memory
        # All that they had is free again.
        until(lambda: edge.num_fds() <= files, lambda: edge.num_fds())
        missed = httpx.get(f"{url}/metrics").text
        process.terminate()
        lines = [line for line in process.communicate(timeout=30)[0].splitlines() if "decision_id" not in line]
    decisions = sum(len(asked.late_ms) for asked in late)
    worst = max(asked.worst_ms for asked in late)
    tables.add(
        "500 hostile clients beside a fleet",
        clients=f"{OF_A_KIND} of each kind",
        connections_at_the_end=connections,
        ended=", ".join(f"{kind.replace('_', ' ')} {ended[kind]}" for kind in KINDS),
        decisions=decisions,
        refused=0,
        latest_ms_past_the_deadline=f"{worst:.0f}",
        latest_ms_without_them=f"{alone.worst_ms:.0f}",
        memory_MB=f"{memory:+.1f}",
        lines_in_the_log=len(lines),
    )
    assert all(ended[kind] >= OF_A_KIND for kind in KINDS)
    assert all(asked.within(SLACK_MS) == 1.0 for asked in late)
    assert "aicvds_deadline_missed_total 0.0" in missed
    # One line a cause and minute.
    assert len(lines) < 30, lines
    assert not any("Traceback" in line for line in lines)
