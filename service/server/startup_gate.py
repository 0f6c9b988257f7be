"""What the edge answers while it loads: that it lives. Imports nothing that takes long: torch is what it waits for."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Callable, Mapping
from typing import Any

from starlette.applications import Starlette
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from service.server.security_headers import SecurityHeaders
from shared.wire import Problem

# As service.api.routes has it: the process lives, and nothing else is said.
_ALIVE = SecurityHeaders(JSONResponse({"status": "ok"}))
_PROBLEM = Problem(title="Service Unavailable", status=503, detail="the edge ends before it has started", errors=[])
_REFUSED = SecurityHeaders(
    JSONResponse(_PROBLEM.model_dump(), 503, headers={"Retry-After": "1"}, media_type="application/problem+json")
)


class StartupGate:
    """An ASGI application that becomes another one as soon as that is loaded.

    Until then ``GET /healthz`` is answered, and every other request waits. Where the other cannot be loaded, those get
    a 503, ``error`` says why, and ``stop`` is called. Where the server is to end before, they get a 503 too. Garbage is
    collected from then on, if it was not before.

    Args:
        load: imports and makes the other, in a thread.
        stop: ends the server.
    """

    def __init__(self, load: Callable[[], Starlette], stop: Callable[[], None]) -> None:
        self.app: Starlette | None = None
        self.error: Exception | None = None
        self._load = load
        self._stop = stop
        self._state: Mapping[str, Any] = {}
        self._settled = asyncio.Event()
        self._ended = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._live(receive, send)
            return
        if not self._settled.is_set():
            if scope["type"] == "http" and (scope["method"], scope["path"]) == ("GET", "/healthz"):
                await _ALIVE(scope, receive, send)
                return
            await self._settled.wait()
        if self.app is None:
            await _REFUSED(scope, receive, send)
            return
        await self.app({**scope, "state": dict(self._state)}, receive, send)

    def give_up(self) -> None:
        """Have nobody wait any longer: the server ends."""
        self._settled.set()

    async def _live(self, receive: Receive, send: Send) -> None:
        """Started at once; ended when the other has ended, or at once where it is not loaded yet."""
        await receive()
        await send({"type": "lifespan.startup.complete"})
        running = asyncio.create_task(self._run(), name="application")
        await receive()
        if self.app is None:
            running.cancel()
        self._ended.set()
        await asyncio.gather(running, return_exceptions=True)
        await send({"type": "lifespan.shutdown.complete"})

    async def _run(self) -> None:
        """Load the other, and keep it running until the server ends."""
        try:
            app = await asyncio.to_thread(self._load)
            async with app.router.lifespan_context(app) as state:
                self.app, self._state = app, state or {}
                # A million objects of torch and others stay as long as the process: no collection need look at them,
                # which takes a tenth of a second in the midst of a decision.
                gc.freeze()
                gc.enable()
                # Python collects again when what is new is a quarter of what it found last: that is little from now on.
                gc.collect()
                self._settled.set()
                await self._ended.wait()
        except Exception as error:
            self.error = error
            self._settled.set()
            self._stop()
        finally:
            gc.enable()
