"""The HTTP server: uvicorn, with an orderly shutdown."""

import asyncio
import ctypes
import logging
import math
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle

from service.observability import logs
from service.server.middleware import StartupGate
from shared.wire.problem import Problem

log = logging.getLogger(__name__)

# Most open connections, and the files reserved for the store and the LLM servers.
_MOST_CONNECTIONS, _OTHER_FILES = 4096, 256
# Seconds between two warnings of one cause, which any client may trigger.
_WARNING_S = 60.0
# Bytes of request line and headers; a regular client's longest are an Idempotency-Key and a trace's state.
_MOST_BYTES = 64 * 1024
# Seconds to the end of a head, from the start of the connection or the first byte of a further request.
MOST_S = 30.0
# The least bytes of an answer that a client has to read in this time: 0.5 KB a second, less than a timely decision
# needs. A page's stream has its own, shorter limit.
TAKEN_BYTES, TAKEN_S = 16 * 1024, 30.0
# The system's buffer for the answers of one connection, bytes; by itself it takes megabytes for a client that does not
# read.
_UNSENT_BYTES = 128 * 1024
# Pipelined requests that wait in one connection. One read of the socket could bring 14,000.
_MOST_WAITING = 16
_TOO_LARGE = Problem(
    title="Request Header Fields Too Large", status=431, detail=f"the headers are larger than {_MOST_BYTES} bytes"
)
_NO_HTTP = Problem(title="Bad Request", status=400, detail="the request is no valid HTTP/1.1")
# At shutdown, the longest time from an accepted connection to the first bytes of its request.
_ARRIVING_S = 0.25
# The longest that shutdown waits for decisions under way, which have to end within 4 s. With the last checkpoints and
# the last commit that is less than the 10 s after which `docker stop` kills.
_SHUTDOWN_S = 5
# Until an idle connection is closed: longer than a step, so that a UAV's stays open.
_KEPT_S = 75
# Names and numbers of mallopt's options (malloc.h).
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_BYTES = 128 * 1024


class OncePerMinute(logging.Filter):
    """Drops a warning that was logged within the last minute; errors with a traceback pass."""

    def __init__(self) -> None:
        super().__init__()
        self._quiet_until: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is logged."""
        if record.levelno < logging.WARNING or record.exc_info:
            return True
        now = time.monotonic()
        if now < self._quiet_until.get(record.msg, -math.inf):
            return False
        self._quiet_until[record.msg] = now + _WARNING_S
        return True


for _logger in (log, logging.getLogger("uvicorn.error")):
    _logger.addFilter(OncePerMinute())


class _Refused(Exception):
    """A complete head is larger than the limit, or too many requests wait already."""


class BoundedHttpProtocol(HttpToolsProtocol):
    """uvicorn's protocol with limits: it answers 431 to a head past 64 KB, and closes after 30 s without a whole head.

    A connection past the limit is closed immediately, which leaves files for the open connections, the store and the
    LLM. Bytes after a body count as a head: trailers and chunk framing. A connection is aborted if its client does not
    read the answer, even while it is closing, and if more than 16 requests wait.
    """

    # Bytes since the last complete part: a head, a piece of a body, a request.
    _unfinished = 0
    # Whether the current bytes completed a part.
    _completed = False
    _refused = False
    # Closes the connection while it waits for a head.
    _timer: asyncio.TimerHandle | None = None
    # Aborts the connection while bytes are unsent.
    _sending: asyncio.TimerHandle | None = None
    # The request that is being answered; uvicorn's ``cycle`` is the last one that has arrived.
    _answered: RequestResponseCycle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.abort()
            log.warning("%d connections: further ones are closed at once", len(self.connections) - 1)
            return
        # Writing is paused while any byte is unsent.
        transport.set_write_buffer_limits(high=0)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNSENT_BYTES)
        self._timer = self.loop.call_later(MOST_S, transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        self._stop_sending()
        # uvicorn marks the last request only, and the others' answers would fail at the closed connection.
        if self._answered is not None:
            self._answered.disconnected = True
            self._answered.message_event.set()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        self._stop_sending()
        super().resume_writing()

    def data_received(self, data: bytes) -> None:
        self._completed = False
        super().data_received(data)
        self._unfinished = 0 if self._completed else self._unfinished + len(data)
        if self._unfinished > _MOST_BYTES and not self.transport.is_closing():
            self._refuse()
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_timer()
        elif self._timer is None:
            # uvicorn's own timer ends with the first byte of the next request.
            self._timer = self.loop.call_later(MOST_S, self.transport.close)

    def on_headers_complete(self) -> None:
        self._completed = True
        # A head in one chunk is complete before its bytes are counted.
        too_large = len(self.url) + sum(len(name) + len(value) for name, value in self.headers) > _MOST_BYTES
        if too_large or len(self.pipeline) >= _MOST_WAITING:
            self._refused = True
            raise _Refused
        super().on_headers_complete()

    def on_chunk_header(self) -> None:
        """Called by httptools after the length of each chunk, before its data."""
        self._completed = True

    def on_body(self, body: bytes) -> None:
        self._completed = True
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._completed = True
        super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """Called by uvicorn when its parser fails; the parser knows no 431."""
        if self._refused:
            self._refuse()
        else:
            self.transport.write(_refusal(self.server_state.default_headers, _NO_HTTP))
            self.transport.close()

    def _refuse(self) -> None:
        # While another answer is pending or has begun, the connection is closed without a 431.
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(_refusal(self.server_state.default_headers, _TOO_LARGE))
        self.transport.close()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._answered = cycle
        super()._start_asgi_task(cycle, app)

    def _watch(self, unsent: int) -> None:
        self._sending = self.loop.call_later(TAKEN_S, self._check, unsent)

    def _check(self, before: int) -> None:
        unsent = self.transport.get_write_buffer_size()
        if before - unsent >= TAKEN_BYTES:
            self._watch(unsent)
        else:
            log.warning("clients do not take their answers: their connections are closed")
            self.transport.abort()

    def _stop_sending(self) -> None:
        if self._sending is not None:
            self._sending.cancel()
            self._sending = None

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def most_connections() -> int:
    """The number of open connections at most: 4,096, or the process's limit of open files less 256; at least 16."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(16, min(_MOST_CONNECTIONS, files - _OTHER_FILES))


def _refusal(default_headers: list[tuple[bytes, bytes]], problem: Problem) -> bytes:
    body = problem.model_dump_json().encode()
    headers: list[tuple[bytes, Any]] = [
        *default_headers,
        (b"content-type", b"application/problem+json"),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
    ]
    return STATUS_LINE[problem.status] + b"".join(b"%s: %s\r\n" % line for line in headers) + b"\r\n" + body


class Server(uvicorn.Server):
    """Serves the edge, even while it loads, until every client that connected before SIGTERM is answered.

    Args:
        load: imports and makes the edge's application, in a thread.
        log_level: of uvicorn; at ``debug`` requests are logged too.

    Attributes:
        gate: the served application, even while it loads.
    """

    def __init__(self, load: Callable[[], Starlette], log_level: str) -> None:
        self.gate = StartupGate(load, self._end)
        config = uvicorn.Config(
            self.gate,
            # uvicorn takes a plain function for an older interface.
            interface="asgi3",
            log_config=None,
            http=BoundedHttpProtocol,
            # The edge has no websockets; their library would read request heads without a limit.
            ws="none",
            log_level=log_level,
            timeout_keep_alive=_KEPT_S,
            timeout_graceful_shutdown=_SHUTDOWN_S,
            access_log=log_level == "debug",
        )
        super().__init__(config)

    @property
    def error(self) -> Exception | None:
        """The error if the edge could not be loaded; the server ends then."""
        return self.gate.error

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer the connected clients, with less time for the LLM; then end the application, which saves its state."""
        self.gate.open()
        if self.gate.app is not None:
            self.gate.app.state.engine.hurry()
        await self._stop_accepting(sockets or [])
        await super().shutdown(sockets)
        # After this uvicorn only logs its end, and raises the signal again.
        logs.hurry()

    def _end(self) -> None:
        self.should_exit = True

    async def _stop_accepting(self, sockets: list[socket.socket]) -> None:
        """Accept the clients that have connected, and wait for their requests: uvicorn would drop them."""
        state = {"server_state": self.server_state, "app_state": self.lifespan.state}
        protocol = partial(BoundedHttpProtocol, config=self.config, **state)
        own = [listening.fileno() for server in self.servers for listening in server.sockets]
        loop = asyncio.get_running_loop()
        for listening in own:
            loop.remove_reader(listening)
        # asyncio drops a client that it has accepted and not connected yet when its server closes.
        await asyncio.sleep(0.01)
        # Nothing runs between the last client and the close, or the system would reset those that come meanwhile.
        clients = [client for listening in own for client in waiting_clients(listening)]
        for close in [*(server.close for server in self.servers), *(listening.close for listening in sockets)]:
            close()
        for client in clients:
            await loop.connect_accepted_socket(protocol, client)
        await asyncio.sleep(_ARRIVING_S)


def waiting_clients(listening: int) -> Iterator[socket.socket]:
    """Accept the clients that wait at a listening socket that does not block."""
    with socket.socket(fileno=os.dup(listening)) as waiting, suppress(BlockingIOError):
        while True:
            yield waiting.accept()[0]


def hand_back_memory() -> None:
    """Make glibc's malloc return freed memory early; call it before the first thread starts. Elsewhere it does nothing.

    By default malloc gives each thread an arena. It also raises its threshold for returning a freed block immediately
    to the size of the largest block freed, and the LLM's states have megabytes each. So freed memory stayed in all
    arenas: after a quarter of an hour with 200 missions 117 MB, and growing; with one arena and fixed thresholds 12 MB.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return
    for option, value in ((_ARENA_MAX, 1), (_MMAP_THRESHOLD, _BYTES), (_TRIM_THRESHOLD, _BYTES)):
        mallopt(option, value)
