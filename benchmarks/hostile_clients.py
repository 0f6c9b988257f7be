"""Hundreds of clients that do not read, read or write a byte a second, or vanish, each with connections of its own."""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

from service.api.live_routes import STATIC

# Longer than a client may take for its headers, or for 16 KB of an answer.
TAKEN_S = 35
FILE, FILES = "vendor/uPlot.esm.js", 17
PIPELINED = f"GET /static/{FILE} HTTP/1.1\r\nhost: x\r\n\r\n".encode() * FILES
POST = b"POST /decide HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\ncontent-length: 1000\r\n\r\n"
# The SO_LINGER value with which a close resets the connection at once.
ABORT = struct.pack("ii", 1, 0)


class Client:
    """Hostile clients, one after the other; each has a connection of its own, which the edge ends."""

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
        """Check that the edge has ended the connection, and no longer sends the rest of its answers."""
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
def hostile(url: str, count: int) -> Iterator[Counter[str]]:
    """Run ``count`` clients of each kind in another thread; yields the numbers of ended connections by kind."""
    parts = urlsplit(url)
    ended: Counter[str] = Counter()
    stopped = threading.Event()

    async def run() -> None:
        address = (parts.hostname or "", parts.port or 0)
        clients = [Client(address, kind, ended).run() for kind in KINDS for _ in range(count)]
        running = [asyncio.create_task(client) for client in clients]
        while not stopped.is_set():
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
        stopped.set()
        clients.join()
    assert failed == []
