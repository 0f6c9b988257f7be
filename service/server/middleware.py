"""The server's wrappers of the application: security headers, and the gate while the edge loads.

This module imports nothing slow such as FastAPI.
"""

import asyncio
import gc
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.wire.problem import Problem

log = logging.getLogger(__name__)

# Refused requests that are logged a minute: any client can cause them. Of one status, only the first is logged, unless
# a request has a traceparent.
_MOST_LOGGED, _MINUTE_S = 60, 60.0
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
}


class SecurityHeaders:
    """Pure ASGI middleware: a browser does not cache answers, frame them, or guess another content type.

    A HEAD request is answered as GET; the server leaves out the body. A stream of events has no HEAD. Refused requests
    are logged with their ``traceparent``.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._minute_ends, self._logged = 0.0, list[int]()

    # A plain function that returns the application's coroutine saves a coroutine per request.
    def __call__(self, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                if message["status"] >= 400:
                    self._log_refusal(scope, message["status"])
            await send(message)

        if scope["type"] != "http":
            return self.app(scope, receive, send)
        # The server keeps the original scope, by which it knows HEAD.
        if scope["method"] == "HEAD" and not scope["path"].endswith("/events"):
            scope = {**scope, "method": "GET"}
        return self.app(scope, receive, send_with_headers)

    def _log_refusal(self, scope: Scope, status: int) -> None:
        now = time.monotonic()
        if now >= self._minute_ends:
            self._minute_ends, self._logged = now + _MINUTE_S, []
        traceparent = Headers(scope=scope).get("traceparent")
        if len(self._logged) < _MOST_LOGGED and (traceparent or status not in self._logged):
            self._logged.append(status)
            about = {"method": scope["method"], "path": scope["path"][:200], "status": status}
            log.info("refused a request", extra=about | ({"traceparent": traceparent[:200]} if traceparent else {}))


# As in service.api.routes.
_ALIVE = SecurityHeaders(JSONResponse({"status": "ok"}))
_PROBLEM = Problem(title="Service Unavailable", status=503, detail="the edge ends before it has started", errors=[])
_REFUSED = SecurityHeaders(
    JSONResponse(_PROBLEM.model_dump(), 503, headers={"Retry-After": "1"}, media_type="application/problem+json")
)


class StartupGate:
    """An ASGI application that passes requests on to the edge's application once that is loaded.

    Until then ``GET /healthz`` is answered, and every other request waits. If the edge cannot be loaded, or the server
    ends before that, the requests that wait get a 503. Garbage collection is enabled after loading.

    Args:
        load: imports and makes the application, in a thread.
        stop: ends the server; called if the application cannot be loaded.

    Attributes:
        app: the application, once it is loaded.
        error: why it could not be loaded, if so.
    """

    def __init__(self, load: Callable[[], Starlette], stop: Callable[[], None]) -> None:
        self.app: Starlette | None = None
        self.error: Exception | None = None
        self._load = load
        self._stop = stop
        self._state: Mapping[str, Any] = {}
        self._opened = asyncio.Event()
        self._ending = asyncio.Event()

    def __call__(self, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        if scope["type"] == "lifespan":
            return self._live(receive, send)
        if self.app is None or not self._opened.is_set():
            return self._before_loading(scope, receive, send)
        # The application's own coroutine saves a coroutine per request.
        return self.app({**scope, "state": dict(self._state)}, receive, send)

    async def _before_loading(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not self._opened.is_set():
            if scope["type"] == "http" and (scope["method"], scope["path"]) == ("GET", "/healthz"):
                await _ALIVE(scope, receive, send)
                return
            await self._opened.wait()
        if self.app is None:
            await _REFUSED(scope, receive, send)
            return
        await self.app({**scope, "state": dict(self._state)}, receive, send)

    async def opened(self) -> None:
        """Wait until the gate is open."""
        await self._opened.wait()

    def open(self) -> None:
        """Release the waiting requests because the server ends."""
        self._opened.set()

    async def _live(self, receive: Receive, send: Send) -> None:
        """The lifespan: starts immediately, and ends after the application, or immediately if that is not loaded."""
        await receive()
        await send({"type": "lifespan.startup.complete"})
        running = asyncio.create_task(self._run(), name="application")
        await receive()
        if self.app is None:
            running.cancel()
        self._ending.set()
        await asyncio.gather(running, return_exceptions=True)
        await send({"type": "lifespan.shutdown.complete"})

    async def _run(self) -> None:
        """Load the application, and run its lifespan until the server ends."""
        try:
            app = await asyncio.to_thread(self._load)
            async with app.router.lifespan_context(app) as state:
                self.app, self._state = app, state or {}
                # The libraries' objects live as long as the process. Freezing them saves time in each full collection.
                gc.freeze()
                gc.enable()
                # Python runs a full collection when new objects exceed a quarter of those in the last one.
                gc.collect()
                self._opened.set()
                await self._ending.wait()
        except Exception as error:
            self.error = error
            self._opened.set()
            self._stop()
        finally:
            gc.enable()
