"""Limits of connections, in number, and of request heads, in bytes and time; uvicorn has none of them."""

from __future__ import annotations

import asyncio
import logging
import math
import resource
from typing import Any

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from shared.problem import Problem

log = logging.getLogger(__name__)

# Open connections at most, and files that are reserved for others: the store, and the LLM servers.
_MOST_CONNECTIONS, _OTHER_FILES = 4096, 256
# Seconds between two warnings about refused connections.
_WARNING_S = 60.0
# Bytes of request line and headers; the longest of an honest client are an Idempotency-Key and a trace's state.
_MOST_BYTES = 64 * 1024
# Seconds to the end of a head, from the connection's beginning or the first byte of a further request.
_MOST_S = 30.0
_PROBLEM = Problem(
    title="Request Header Fields Too Large", status=431, detail=f"the headers are larger than {_MOST_BYTES} bytes"
)


class _TooLarge(Exception):
    """A complete head is larger than the limit."""


class BoundedHttpProtocol(HttpToolsProtocol):
    """uvicorn's protocol with limits: it answers 431 to a head past 64 KB, and closes after 30 s without a whole head.

    A connection past the limit is closed at once, so that files are left for the open connections, the store and the
    LLM. Bytes after a body count as a head too: trailers, and the bytes of chunks beside their data.
    """

    # Until then refused connections are not logged again.
    _quiet_until = -math.inf
    # Bytes since the last part that was complete: a head, a piece of a body, a request.
    _unfinished = 0
    # Whether the bytes at hand completed a part.
    _completed = False
    _too_large = False
    # Closes the connection while it waits for a head.
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.abort()
            if self.loop.time() > BoundedHttpProtocol._quiet_until:
                BoundedHttpProtocol._quiet_until = self.loop.time() + _WARNING_S
                log.warning("%d connections: further ones are closed at once", len(self.connections) - 1)
            return
        self._timer = self.loop.call_later(_MOST_S, transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        super().connection_lost(exc)

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
            super().send_400_response(msg)

    def _refuse(self) -> None:
        # While another answer is due or has begun, the connection is closed without a 431.
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(_refusal(self.server_state.default_headers))
        self.transport.close()

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
