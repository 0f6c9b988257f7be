"""Connections, bounded in number, and heads of requests, in bytes and time; uvicorn bounds none of them."""

from __future__ import annotations

import asyncio
import logging
import math
import resource
from typing import Any

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from shared.wire import Problem

log = logging.getLogger(__name__)

# At once, if the process may open so many files; those that others need are kept: the store's, and the LLM servers'.
_MOST_CONNECTIONS, _OTHER_FILES = 4096, 256
# How often that is told.
_TOLD_S = 60.0
# Request line and headers; the longest that an honest client sends is an Idempotency-Key and a trace's state.
_MOST_BYTES = 64 * 1024
# From a connection's being made, or a further request's first byte, to the end of its head.
_MOST_S = 30.0
_PROBLEM = Problem(
    title="Request Header Fields Too Large", status=431, detail=f"the headers are larger than {_MOST_BYTES} bytes"
)


class _TooLarge(Exception):
    """A head is complete, and larger than it may be."""


class BoundedHttpProtocol(HttpToolsProtocol):
    """uvicorn's protocol, which answers 431 to a head past 64 KB and hangs up on one that is not sent within 30 s.

    It hangs up at once on a connection for which no file is left, so that those that there are, the store and the LLM
    go on. What follows a body counts as a head too: trailers, and what chunks carry beside their data.
    """

    _told_until = -math.inf
    # Since the last that was complete: a head, a piece of a body, a request.
    _unfinished = 0
    _went_on = False
    _too_large = False
    _hang_up: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > most_connections():
            transport.abort()
            if self.loop.time() > BoundedHttpProtocol._told_until:
                BoundedHttpProtocol._told_until = self.loop.time() + _TOLD_S
                log.warning("%d connections: whoever comes next is hung up on", len(self.connections) - 1)
            return
        self._hang_up = self.loop.call_later(_MOST_S, transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._went_on = False
        super().data_received(data)
        self._unfinished = 0 if self._went_on else self._unfinished + len(data)
        if self._unfinished > _MOST_BYTES and not self.transport.is_closing():
            self._refuse()
        if self._answers:
            self._stop_waiting()
        elif self._hang_up is None:
            # uvicorn waits for the next request until its first byte only.
            self._hang_up = self.loop.call_later(_MOST_S, self.transport.close)

    def on_headers_complete(self) -> None:
        self._went_on = True
        # As one chunk they may have come before they could be counted.
        if len(self.url) + sum(len(name) + len(value) for name, value in self.headers) > _MOST_BYTES:
            self._too_large = True
            raise _TooLarge
        super().on_headers_complete()

    def on_chunk_header(self) -> None:
        """httptools tells of each chunk's length before its data."""
        self._went_on = True

    def on_body(self, body: bytes) -> None:
        self._went_on = True
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._went_on = True
        super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """What uvicorn answers to anything that the parser does not take; its parser has no words for 431."""
        if self._too_large:
            self._refuse()
        else:
            super().send_400_response(msg)

    @property
    def _answers(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _refuse(self) -> None:
        if not self._answers:
            self.transport.write(_refusal(self.server_state.default_headers))
        # Else another answer is due first, or has begun.
        self.transport.close()

    def _stop_waiting(self) -> None:
        if self._hang_up is not None:
            self._hang_up.cancel()
            self._hang_up = None


def most_connections() -> int:
    """How many may be open at once: 4,096, or as many as the process may open files, less 256; 16 at least."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(16, min(_MOST_CONNECTIONS, files - _OTHER_FILES))


def _refusal(headers: list[tuple[bytes, bytes]]) -> bytes:
    body = _PROBLEM.model_dump_json().encode()
    told: list[tuple[bytes, Any]] = [
        *headers,
        (b"content-type", b"application/problem+json"),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
    ]
    return STATUS_LINE[431] + b"".join(b"%s: %s\r\n" % line for line in told) + b"\r\n" + body
