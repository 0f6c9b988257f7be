"""The HTTP server: uvicorn's, which ends in order."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

import uvicorn
from starlette.applications import Starlette

from service.observability import logs
from service.server.connection_limits import BoundedHttpProtocol
from service.server.startup_gate import StartupGate

# The longest that a request takes from its connection's being accepted to its first bytes, when the service ends.
_ARRIVING_S = 0.25
# In-flight decisions are hurried to end within 4 s; past this, shutting down does not wait for them. With the last
# checkpoints and the last commit it is less than the 10 s after which `docker stop` kills.
_SHUTDOWN_S = 5


class Server(uvicorn.Server):
    """Serves the edge, from before it is loaded until everyone who connected before SIGTERM is answered.

    Args:
        load: imports and makes the edge, in a thread.
        log_level: uvicorn's; at ``debug`` requests are logged too.

    Attributes:
        error: why the edge could not be loaded, if so: the server ends then.
    """

    def __init__(self, load: Callable[[], Starlette], log_level: str) -> None:
        self._loading = StartupGate(load, self._end)
        config = uvicorn.Config(
            self._loading,
            log_config=None,
            http=BoundedHttpProtocol,
            # There are none; their library would take heads that nobody counts.
            ws="none",
            log_level=log_level,
            timeout_graceful_shutdown=_SHUTDOWN_S,
            access_log=log_level == "debug",
        )
        super().__init__(config)

    @property
    def error(self) -> Exception | None:
        """As the class says."""
        return self._loading.error

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer who has connected, hurrying whoever waits for the LLM; then keep what is to be kept."""
        self._loading.give_up()
        if self._loading.app is not None:
            self._loading.app.state.engine.hurry()
        await self._close_the_door(sockets or [])
        await super().shutdown(sockets)
        # What uvicorn does after this is to say goodbye, and to raise the signal again.
        logs.hurry()

    def _end(self) -> None:
        self.should_exit = True

    async def _close_the_door(self, sockets: list[socket.socket]) -> None:
        """Accept who has connected, then nobody else, and let their requests arrive: uvicorn would drop them."""
        for _ in range(3):
            await asyncio.sleep(0)
        for server in self.servers:
            server.close()
        for listening in sockets:
            listening.close()
        await asyncio.sleep(_ARRIVING_S)
