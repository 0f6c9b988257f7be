"""Limits on requests: their concurrency, and the time and size of a body, before and after decompression."""

import asyncio
import re
import zlib
from collections.abc import Awaitable, Callable
from itertools import islice

import zstandard
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.problem_details import problem_response

# Methods without a body.
READING = ("GET", "HEAD")
# Never refused: probes, metrics, the page's files, and its streams, which have a limit of their own. Few of them need a
# key, so they must not take the places of other requests.
_UNCOUNTED = re.compile(r"/(healthz|readyz|metrics|static/.*|missions/[^/]+/events)?")
# While a body arrives, its request counts against the limit of concurrent requests.
BODY_S = 10.0
# A batch has some thousand names of fields, a scenario at most 100,000 waypoints.
_NAME, _MOST_NAMES, _MOST_LISTS = re.compile(rb'"\s*:'), 20_000, 120_000


class _TooLarge(Exception):
    """The body exceeds the limit, before or after decompression."""


class _TooManyParts(Exception):
    """The body has more parts than any request: to parse them all would take most of a second."""


class _Damaged(Exception):
    """The body does not match its Content-Encoding."""


class RequestLimits:
    """Pure ASGI middleware: limits concurrent requests, and reads their bodies.

    Past ``most`` concurrent requests it answers 503 with ``Retry-After``, without reading the body. Probes, metrics,
    the page's files and its streams do not count. A request counts until its answer begins, because a client may read
    slowly. If bodies are still arriving, the one that began first gets a 408 instead, because a client may write
    slowly. It reads a body up to ``limit`` bytes and decodes ``Content-Encoding: gzip | zstd``. It answers 413 past the
    limit, 408 for a body that takes longer than 10 s, 415 for another encoding and 400 for a damaged body. Each refusal
    is a problem document.
    """

    def __init__(self, app: ASGIApp, most: int, limit: int) -> None:
        self.app = app
        self._most = most
        self._limit = limit
        self._running = 0
        # The time limits of the bodies that are arriving, the oldest first.
        self._arriving: dict[asyncio.Timeout, None] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["method"] in READING and _UNCOUNTED.fullmatch(scope["path"])):
            await self.app(scope, receive, send)
            return
        if self._running >= self._most and not self._make_room():
            response = problem_response(503, f"{self._most} requests are in progress already")
            response.headers["Retry-After"] = "1"
            response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        self._running += 1
        counts = True

        def answer(message: Message) -> Awaitable[None]:
            nonlocal counts
            self._running -= counts
            counts = False
            return send(message)

        try:
            if scope["method"] in ("POST", "PUT", "PATCH"):
                body = await self._body(scope, receive, answer)
                if body is None:
                    return
                pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

                async def replayed() -> Message:
                    return pending.pop() if pending else await receive()

                await self.app(scope, replayed, answer)
            else:
                await self.app(scope, receive, answer)
        finally:
            self._running -= counts

    def _make_room(self) -> bool:
        """End the wait for the oldest body that is arriving; returns False if there is none."""
        for oldest in self._arriving:
            del self._arriving[oldest]
            if not oldest.expired():
                oldest.reschedule(0.0)
            return True
        return False

    async def _body(self, scope: Scope, receive: Receive, send: Send) -> bytes | None:
        """The decoded body, to which the scope's headers are adapted; None if the request is already answered."""
        headers = dict(scope["headers"])
        encoding = headers.get(b"content-encoding", b"identity").decode("latin-1").strip().lower()
        if encoding not in _DECODERS and encoding not in _PLAIN:
            response = problem_response(415, f"Content-Encoding {encoding[:40]!r}: use gzip, zstd or none")
            response.headers["Accept-Encoding"] = "gzip, zstd"
            await response(scope, receive, send)
            return None
        try:
            async with asyncio.timeout(BODY_S) as limit:
                self._arriving[limit] = None
                try:
                    body = await self._read(receive, headers.get(b"content-length", b""))
                finally:
                    self._arriving.pop(limit, None)
            if body is None:
                return None
            if encoding in _DECODERS:
                body = _DECODERS[encoding](body, self._limit)
            # Few bodies have so many colons, and counting these takes a tenth of the time.
            if body.count(b":") > _MOST_NAMES < len(list(islice(_NAME.finditer(body), _MOST_NAMES + 1))):
                raise _TooManyParts(f"has more than {_MOST_NAMES} names")
            if body.count(b"[") + body.count(b"{") > _MOST_LISTS:
                raise _TooManyParts(f"has more than {_MOST_LISTS} lists and objects")
        except (_TooLarge, TimeoutError, _Damaged, _TooManyParts) as fault:
            await self._refusal(fault)(scope, receive, send)
            return None
        if encoding in _DECODERS or b"content-length" not in headers:
            scope["headers"] = [(n, v) for n, v in scope["headers"] if n.lower() not in _REWRITTEN]
            scope["headers"].append((b"content-length", str(len(body)).encode()))
        return body

    def _refusal(self, fault: Exception) -> Response:
        """The problem document; the connection ends where the rest of the body may still arrive."""
        match fault:
            case TimeoutError():
                status = 408
                problem = f"not received within {BODY_S:g} s, or in less while {self._most} requests are in progress"
            case _Damaged():
                status, problem = 400, str(fault)
            case _TooManyParts():
                status, problem = 422, str(fault)
            case _:
                status, problem = 413, f"larger than {self._limit} bytes"
        response = problem_response(status, f"body: {problem}", [{"field": "body", "problem": problem}])
        if status not in (400, 422):
            response.headers["Connection"] = "close"
        return response

    async def _read(self, receive: Receive, content_length: bytes) -> bytes | None:
        """The body; None if the client disconnected before its end."""
        if content_length.isdigit() and int(content_length) > self._limit:
            raise _TooLarge
        body = bytearray()
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            body += message.get("body", b"")
            if len(body) > self._limit:
                raise _TooLarge
            if not message.get("more_body", False):
                return bytes(body)


def _gunzip(body: bytes, limit: int) -> bytes:
    decoder = zlib.decompressobj(wbits=31)
    try:
        plain = decoder.decompress(body, limit + 1)
    except zlib.error:
        raise _Damaged("not valid gzip") from None
    if len(plain) > limit:
        raise _TooLarge
    if not decoder.eof:
        raise _Damaged("gzip ends too early")
    if decoder.unused_data:
        raise _Damaged("there is data after the gzip member")
    return plain


def _unzstd(body: bytes, limit: int) -> bytes:
    """The stream reader limits the size but hides a missing end; the object detects the end but has no limit."""
    decompressor = zstandard.ZstdDecompressor(max_window_size=2**23)
    try:
        with decompressor.stream_reader(body) as reader:
            if len(reader.read(limit + 1)) > limit:
                raise _TooLarge
        decoder = decompressor.decompressobj()
        plain = decoder.decompress(body)
    except zstandard.ZstdError:
        raise _Damaged("not valid zstd") from None
    if not decoder.eof:
        raise _Damaged("zstd ends too early")
    if decoder.unused_data:
        raise _Damaged("there is data after the zstd frame")
    return plain


_REWRITTEN = (b"content-encoding", b"content-length", b"transfer-encoding")
_PLAIN = ("", "identity")
_DECODERS: dict[str, Callable[[bytes, int], bytes]] = {"gzip": _gunzip, "zstd": _unzstd}
