"""The limit on concurrent requests."""

from __future__ import annotations

import re

from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.problem_details import problem_response

# Methods without a body.
READING = ("GET", "HEAD")
_NEVER_REFUSED = frozenset(("/healthz", "/readyz", "/metrics"))
# A page's stream lasts as long as the page and has a limit of its own.
_STREAMS = re.compile(r"/missions/[^/]+/events")


class ConcurrencyLimit:
    """Pure ASGI middleware: past ``most`` concurrent requests it answers 503 with ``Retry-After``.

    Probes, metrics and the streams of pages do not count. The body of a refused request is not read.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        self.app = app
        self._most = most
        self._running = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (
            scope["method"] in READING
            and (scope["path"] in _NEVER_REFUSED or _STREAMS.fullmatch(scope["path"]) is not None)
        ):
            await self.app(scope, receive, send)
            return
        if self._running >= self._most:
            response = problem_response(503, f"{self._most} requests are in progress already")
            response.headers["Retry-After"] = "1"
            response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        self._running += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self._running -= 1
