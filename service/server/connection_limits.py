"""Limits of connections: their number, request heads in bytes and time, unread answers; uvicorn has none of them."""

from __future__ import annotations

import asyncio
import logging
import math
import resource
from typing import Any, ClassVar

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle

from shared.problem import Problem

log = logging.getLogger(__name__)

# Open connections at most, and files that are reserved for others: the store, and the LLM servers.
_MOST_CONNECTIONS, _OTHER_FILES = 4096, 256
# Seconds between two warnings of one cause.
_WARNING_S = 60.0
# Bytes of request line and headers; the longest of an honest client are an Idempotency-Key and a trace's state.
_MOST_BYTES = 64 * 1024
# Seconds to the end of a head, from the connection's beginning or the first byte of a further request.
_MOST_S = 30.0
# In each such time, in seconds, a client that has an answer to read takes so many bytes of it, or all.
_READ_S, _LEAST_READ = 30.0, 16 * 1024
_PROBLEM = Problem(
    title="Request Header Fields Too Large", status=431, detail=f"the headers are larger than {_MOST_BYTES} bytes"
)


class _TooLarge(Exception):
    """A complete head is larger than the limit."""


class BoundedHttpProtocol(HttpToolsProtocol):
    """uvicorn's protocol with limits: it answers 431 to a head past 64 KB, and closes after 30 s without a whole head.

    A connection past the limit is closed at once, so that files are left for the open connections, the store and the
    LLM. Bytes after a body count as a head too: trailers, and the bytes of chunks beside their data.

    A connection whose client does not read is aborted: in 30 s it takes 16 KB, or all that is left of its answers. Also
    a closed connection is aborted then, which otherwise waits for its client for ever. Of pipelined requests no more
    are read until those that were read are answered.
    """

    # By cause, until when it is not logged again.
    _quiet_until: ClassVar[dict[str, float]] = {}
    # Bytes since the last part that was complete: a head, a piece of a body, a request.
    _unfinished = 0
    # Whether the bytes at hand completed a part.
    _completed = False
    _too_large = False
    # Closes the connection while it waits for a head.
    _timer: asyncio.TimerHandle | None = None
    # Aborts the connection while its client reads too little.
    _reading: asyncio.TimerHandle | None = None
    # The request that is being answered; uvicorn's ``cycle`` is the one that was read last.
    _answered: RequestResponseCycle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.abort()
            self._warn("%d connections: further ones are closed at once", len(self.connections) - 1)
            return
        self._timer = self.loop.call_later(_MOST_S, transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        self._stop_watching()
        self._give_up()
        super().connection_lost(exc)

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._answered = cycle
        super()._start_asgi_task(cycle, app)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.pipeline:
            self.flow.pause_reading()
        self._watch_reading()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stop_watching()

    def data_received(self, data: bytes) -> None:
        self._completed = False
        if not self.flow.write_paused:
            # More answers will follow, and a client that reads none of them soon fills the buffer.
            self._stop_watching()
        super().data_received(data)
        self._unfinished = 0 if self._completed else self._unfinished + len(data)
        if self._unfinished > _MOST_BYTES and not self.transport.is_closing():
            self._refuse()
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_timer()
        elif self._timer is None:
            # uvicorn's own timer ends with the first byte of the next request.
            self._timer = self.loop.call_later(_MOST_S, self.transport.close)

    def on_headers_complete(self) -> None:
        self._completed = True
        # A head that comes as one chunk is complete before its bytes are counted.
        if len(self.url) + sum(len(name) + len(value) for name, value in self.headers) > _MOST_BYTES:
            self._too_large = True
            raise _TooLarge
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
        if self._too_large:
            self._refuse()
        else:
            self._give_up()
            super().send_400_response(msg)
            self._watch_reading()

    def _refuse(self) -> None:
        # While another answer is due or has begun, the connection is closed without a 431.
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(_refusal(self.server_state.default_headers))
        self._give_up()
        self.transport.close()
        self._watch_reading()

    def _give_up(self) -> None:
        """Write no more of an answer: each write to a closed connection would be a line in the log."""
        if self._answered is not None and not self._answered.response_complete:
            self._answered.disconnected = True
            self._answered.message_event.set()

    def _watch_reading(self) -> None:
        """Abort the connection in 30 s unless its client has read enough by then."""
        left = self.transport.get_write_buffer_size()
        if left and self._reading is None:
            self._reading = self.loop.call_later(_READ_S, self._check_reading, left)

    def _stop_watching(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None

    def _check_reading(self, before: int) -> None:
        self._reading = None
        left = self.transport.get_write_buffer_size()
        if left > max(0, before - _LEAST_READ):
            self._warn("a client does not read its answers: its connection is aborted")
            self.transport.abort()
        else:
            self._watch_reading()

    def _warn(self, text: str, *values: object) -> None:
        now = self.loop.time()
        if now > self._quiet_until.get(text, -math.inf):
            self._quiet_until[text] = now + _WARNING_S
            log.warning(text, *values)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def most_connections() -> int:
    """The number of open connections at most: 4,096, or the process's limit of open files less 256; at least 16."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(16, min(_MOST_CONNECTIONS, files - _OTHER_FILES))


def _refusal(default_headers: list[tuple[bytes, bytes]]) -> bytes:
    body = _PROBLEM.model_dump_json().encode()
    headers: list[tuple[bytes, Any]] = [
        *default_headers,
        (b"content-type", b"application/problem+json"),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
    ]
    return STATUS_LINE[431] + b"".join(b"%s: %s\r\n" % line for line in headers) + b"\r\n" + body
