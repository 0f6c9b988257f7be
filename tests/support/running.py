"""Real servers for tests: an ASGI application or a raw TCP handler on a loopback port, in a thread."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

import uvicorn
from starlette.types import ASGIApp

from service.server.server import BoundedHttpProtocol
from tests.support.waiting import PATIENCE_S

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class _Server(uvicorn.Server):
    """A uvicorn server that stops at once on request; uvicorn's own stops after two to three tenths of a second."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self._loop, self._stop_requested = asyncio.get_running_loop(), asyncio.Event()
        await super().startup(sockets)

    def end(self) -> None:
        """Request the stop, from any thread."""
        self._loop.call_soon_threadsafe(self._stop_requested.set)

    async def main_loop(self) -> None:
        await self.on_tick(0)
        await self._stop_requested.wait()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for server in self.servers:
            server.close()
        for connection in list(self.server_state.connections):
            connection.shutdown()
        while self.server_state.connections or self.server_state.tasks:
            await asyncio.sleep(0.002)
        await self.lifespan.shutdown()


@contextmanager
def serving(app: ASGIApp, port: int = 0, certificate: str | None = None) -> Iterator[str]:
    """Serve the application by a real uvicorn with the edge's limits on headers; yields its base URL.

    Args:
        certificate: a PEM file with a key and a certificate, to serve HTTPS.
    """
    config = uvicorn.Config(
        app,
        interface="asgi3",
        host="127.0.0.1",
        port=port,
        log_level="warning",
        # The edge itself serves no TLS; its limits look at the socket.
        http=BoundedHttpProtocol if certificate is None else "h11",
        ws="none",
        ssl_certfile=certificate,
    )
    server = _Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        if not thread.is_alive():
            raise RuntimeError("the server did not start")
        time.sleep(0.002)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield f"http{'s' if certificate else ''}://127.0.0.1:{port}"
    finally:
        server.end()
        thread.join(PATIENCE_S)


@contextmanager
def listening(handler: Handler) -> Iterator[str]:
    """Run a raw TCP server, for LLM servers that break HTTP; yields its base URL."""
    loop = asyncio.new_event_loop()
    started = threading.Event()
    address: list[str] = []
    transports: set[asyncio.WriteTransport] = set()

    async def run() -> None:
        async def connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            transports.add(writer.transport)
            try:
                await handler(reader, writer)
            except (ConnectionError, asyncio.IncompleteReadError):
                return
            finally:
                writer.close()

        server = await asyncio.start_server(connection, "127.0.0.1", 0)
        address.append(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}")
        started.set()
        async with server:
            await stop.wait()

    async def until_stopped() -> None:
        await run()
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        for transport in transports:
            # A closed transport whose peer has not read everything stays open, and warns in whichever test runs later.
            transport.abort()
        await asyncio.sleep(0)

    stop = asyncio.Event()
    thread = threading.Thread(target=lambda: loop.run_until_complete(until_stopped()), daemon=True)
    thread.start()
    assert started.wait(PATIENCE_S)
    try:
        yield address[0]
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE_S)
        loop.close()
