"""Connections that go on in another process of the same edge: no byte of an answer passes through two processes.

The process that got a request sends the connection's descriptor to the process that decides its mission, together with
the request. The further requests of the connection arrive there at once.
"""

from __future__ import annotations

import asyncio
import os
import socket
from array import array
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from starlette.types import Scope

from service.config.process_member import Member
from service.server.connection_limits import BoundedHttpProtocol

# The entry of an ASGI scope with the request's connection.
CONNECTION = "aicvds.connection"
# The entry that says that the request has come here with its connection from another process.
ARRIVED = "aicvds.arrived"
# How long a process that has many connections to take over is waited for, and how often it is tried.
_WAIT_S, _RETRY_S = 1.0, 0.002
_LEFT_OUT = (b"expect", b"content-length", b"transfer-encoding")


class MovableHttpProtocol(BoundedHttpProtocol):
    """A connection that can be given to another process while it waits for an answer.

    Args:
        first: what was read from the connection before it came here.
    """

    def __init__(self, *args: Any, first: bytes = b"", **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._first = first
        self._pipelined = self._arriving = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        first, self._first = self._first, b""
        if first and not transport.is_closing():
            self._arriving = True
            self.data_received(first)
            self._arriving = False

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self.scope[CONNECTION] = self  # type: ignore[literal-required]
        self.scope[ARRIVED] = self._arriving  # type: ignore[literal-required]
        if self.cycle is not None and not self.cycle.response_complete:
            self._pipelined = True

    @property
    def movable(self) -> bool:
        """Whether the connection has nothing but one whole request that waits for its answer.

        The rest of a body would arrive at the other process as a request of its own.
        """
        whole = not self._pipelined and not self.cycle.more_body
        return whole and not self.cycle.response_started and not self.transport.get_write_buffer_size()

    @property
    def descriptor(self) -> int | None:
        """The connection's descriptor; None where it is closed."""
        if self.transport.is_closing():
            return None
        descriptor: int = self.transport.get_extra_info("socket").fileno()
        return descriptor

    def leave(self) -> None:
        """Give the connection up here; it goes on where its descriptor was sent."""
        self.transport.abort()


class Mover:
    """Sends connections to the other processes of an edge."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    async def move(self, connection: MovableHttpProtocol, slot: int, request: bytes) -> bool:
        """Send a connection with its request; returns whether that process has them, or the client is gone."""
        loop = asyncio.get_running_loop()
        ends = loop.time() + _WAIT_S
        # The request travels in memory of its own: a datagram would be too small for a large one.
        with os.fdopen(os.memfd_create("request"), "wb", buffering=0) as memory:
            _write(memory.fileno(), request)
            while (descriptor := connection.descriptor) is not None:
                # Meanwhile a second request may have come.
                if not connection.movable:
                    return False
                try:
                    # socket.send_fds ignores its address (CPython 3.11 to 3.13).
                    files = socket.SOL_SOCKET, socket.SCM_RIGHTS, array("i", (descriptor, memory.fileno()))
                    self._socket.sendmsg([b"\0"], [files], 0, self._member.connections_of(slot))
                    connection.leave()
                    break
                except BlockingIOError:
                    if loop.time() > ends:
                        return False
                except OSError:
                    return False
                await asyncio.sleep(_RETRY_S)
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class MovedConnections:
    """Takes over the connections that the other processes send.

    Args:
        protocol: makes the protocol of a connection.
    """

    def __init__(self, path: str, protocol: Callable[..., MovableHttpProtocol]) -> None:
        self._protocol = protocol
        self._loop = asyncio.get_running_loop()
        self._tasks = set[asyncio.Task[Any]]()
        # Of a process that was killed.
        Path(path).unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(path)
        self._loop.add_reader(self._socket.fileno(), self._receive)

    def close(self) -> None:
        """Take over what has been sent, and nothing more."""
        if self._socket.fileno() >= 0:
            self._receive()
            self._loop.remove_reader(self._socket.fileno())
            self._socket.close()

    def _receive(self) -> None:
        with suppress(BlockingIOError):
            while True:
                _, files, _, _ = socket.recv_fds(self._socket, 1, 2)
                if len(files) == 2:
                    self._take(*files)
                else:
                    # The process may open no more files: the connection ends with its descriptor.
                    for file in files:
                        os.close(file)

    def _take(self, connection: int, memory: int) -> None:
        first = os.pread(memory, os.fstat(memory).st_size, 0)
        os.close(memory)
        taken = socket.socket(fileno=connection)
        task = self._loop.create_task(
            self._loop.connect_accepted_socket(partial(self._protocol, first=first), taken), name="moved-connection"
        )
        self._tasks.add(task)
        task.add_done_callback(self._taken)

    def _taken(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        # The client may have closed the connection meanwhile.
        if not task.cancelled():
            task.exception()


def request_bytes(scope: Scope, body: bytes) -> bytes:
    """An ASGI request as it is sent: with its whole body, decoded, as :class:`RequestLimits` leaves it."""
    target = scope["raw_path"] + (b"?" + scope["query_string"] if scope["query_string"] else b"")
    line = b"%s %s HTTP/%s\r\n" % (scope["method"].encode(), target, scope["http_version"].encode())
    fields = [b"%s: %s\r\n" % field for field in scope["headers"] if field[0] not in _LEFT_OUT]
    if body:
        fields.append(b"content-length: %d\r\n" % len(body))
    return line + b"".join(fields) + b"\r\n" + body


def _write(file: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(file, left) :]
