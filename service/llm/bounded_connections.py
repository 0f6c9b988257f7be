"""Connections to LLM servers, bounded in what one call brings: aiohttp reads heads without end, on the loop."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import aiohttp
from aiohttp.client_proto import ResponseHandler

# What comes beside the body: heads, of which there may be several, the frames of chunks, trailers.
_BESIDE_BYTES = 64 * 1024
_ALLOWED: ContextVar[int] = ContextVar("body bytes of the call at hand")


class TooMuch(aiohttp.ClientConnectionError):
    """The server sent more than an answer can be."""


@contextmanager
def allowing(most: int) -> Iterator[None]:
    """A request that begins in here is hung up past ``most`` bytes of body and 64 KB of what is beside it."""
    before = _ALLOWED.set(most)
    try:
        yield
    finally:
        _ALLOWED.reset(before)


class BoundedConnector(aiohttp.TCPConnector):
    """aiohttp's, which makes bounded connections. Every request on them begins in :func:`allowing`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        # aiohttp offers no other way to say what reads a connection.
        kind: type[ResponseHandler] = _Bounded
        self._factory = functools.partial(kind, loop=self._loop)


class _Bounded(ResponseHandler):
    _left = 0

    def set_response_params(self, **params: Any) -> None:
        """aiohttp's word that a request begins, in the task that makes it."""
        self._left = _ALLOWED.get() + _BESIDE_BYTES
        super().set_response_params(**params)

    def data_received(self, data: bytes) -> None:
        self._left -= len(data)
        if self._left >= 0 or self.transport is None:
            super().data_received(data)
            return
        error = TooMuch()
        self.set_exception(error)
        if self._payload is not None:
            self._payload.set_exception(error)
        # A connection between two requests too: what it sends unasked would be read for ever.
        self.transport.abort()
