"""The door: requests are bounded in number, and bodies in time and in size, before and after they are unpacked."""

from __future__ import annotations

import re

from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.problem_details import problem_response

# What is read has no body: nothing of it is kept.
READING = ("GET", "HEAD")
_NEVER_REFUSED = frozenset(("/healthz", "/readyz", "/metrics"))
# A page's stream lasts as long as the page: it has a limit of its own, and takes no decision's place.
_STREAMS = re.compile(r"/missions/[^/]+/events")


class ConcurrencyLimit:
    """Pure ASGI middleware: past ``most`` requests in hand 503 with ``Retry-After``.

    Probes, metrics and the streams of pages do not count.

    Nothing of the refused body is read.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        self.app = app
        self._most = most
        self._inside = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or _is_let_in(scope["method"], scope["path"]):
            await self.app(scope, receive, send)
            return
        if self._inside >= self._most:
            response = problem_response(503, f"{self._most} requests are in hand already")
            response.headers["Retry-After"] = "1"
            response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        self._inside += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self._inside -= 1


def _is_let_in(method: str, path: str) -> bool:
    return method in READING and (path in _NEVER_REFUSED or _STREAMS.fullmatch(path) is not None)
