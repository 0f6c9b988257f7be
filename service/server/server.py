"""The HTTP server: uvicorn, with an orderly shutdown."""

import asyncio
import socket
from collections.abc import Callable

import uvicorn
from starlette.applications import Starlette

from service.observability import logs
from service.server.connection_limits import BoundedHttpProtocol
from service.server.middleware import StartupGate

# At shutdown, the longest time from an accepted connection to the first bytes of its request.
_ARRIVING_S = 0.25
# The longest that shutdown waits for decisions under way, which have to end within 4 s. With the last checkpoints and
# the last commit that is less than the 10 s after which `docker stop` kills.
_SHUTDOWN_S = 5


class Server(uvicorn.Server):
    """Serves the edge, even while it loads, until every client that connected before SIGTERM is answered.

    Args:
        load: imports and makes the edge's application, in a thread.
        log_level: of uvicorn; at ``debug`` requests are logged too.

    Attributes:
        gate: the served application, even while it loads.
    """

    def __init__(self, load: Callable[[], Starlette], log_level: str) -> None:
        self.gate = StartupGate(load, self._end)
        config = uvicorn.Config(
            self.gate,
            # uvicorn takes a plain function for an older interface.
            interface="asgi3",
            log_config=None,
            http=BoundedHttpProtocol,
            # The edge has no websockets; their library would read request heads without a limit.
            ws="none",
            log_level=log_level,
            timeout_graceful_shutdown=_SHUTDOWN_S,
            access_log=log_level == "debug",
        )
        super().__init__(config)

    @property
    def error(self) -> Exception | None:
        """The error if the edge could not be loaded; the server ends then."""
        return self.gate.error

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer the connected clients, with less time for the LLM; then end the application, which saves its state."""
        self.gate.open()
        if self.gate.app is not None:
            self.gate.app.state.engine.hurry()
        await self._stop_accepting(sockets or [])
        await super().shutdown(sockets)
        # After this uvicorn only logs its end, and raises the signal again.
        logs.hurry()

    def _end(self) -> None:
        self.should_exit = True

    async def _stop_accepting(self, sockets: list[socket.socket]) -> None:
        """Accept the clients that have connected, and wait for their requests: uvicorn would drop them."""
        for _ in range(3):
            await asyncio.sleep(0)
        for server in self.servers:
            server.close()
        for listening in sockets:
            listening.close()
        await asyncio.sleep(_ARRIVING_S)
