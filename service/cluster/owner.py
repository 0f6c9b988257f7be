"""An edge that owns missions: an ordinary edge in a Ray process, with its own address."""

from __future__ import annotations

import asyncio
import socket
from functools import partial
from typing import TYPE_CHECKING

from service.cluster.exchange import Exchanged, answer_of
from service.cluster.merging import DECIDED_AT, Answer
from service.config.settings import Settings
from service.observability import logs
from service.server.server import Server

if TYPE_CHECKING:
    from fastapi import FastAPI


class Owner:
    """One edge, whose requests come from the ingress; requests for missions that moved here come to its own address.

    Args:
        host: the address at which it listens; None for its machine's address in the cluster.
    """

    def __init__(self, settings: Settings, host: str | None) -> None:
        import ray

        logs.configure(settings.log_level, settings.log_format)
        own_host: str = host or ray.util.get_node_ip_address()  # type: ignore[no-untyped-call]
        self._listener = socket.create_server((own_host, 0))
        self._url = f"http://{own_host}:{self._listener.getsockname()[1]}"
        own = settings.model_copy(update={"advertise_url": self._url})
        self._server = Server(partial(_application, own), settings.log_level)
        self._serving: asyncio.Task[None] | None = None

    async def answer(self, request: Exchanged) -> Answer:
        """The edge's answer to a request."""
        return await answer_of(self._server.gate, request)

    async def named_answer(self, request: Exchanged) -> tuple[str, Answer]:
        """The edge's address and its answer, with the time of its newest decision."""
        answer = await self.answer(request)
        app = self._server.gate.app
        decided_at: float = 0.0 if app is None else app.state.engine.live.history.decided_at
        answer.headers.append((DECIDED_AT.encode(), repr(decided_at).encode()))
        return self._url.removeprefix("http://"), answer

    async def address(self) -> str:
        """The edge's URL."""
        return self._url

    async def check_health(self) -> None:
        """Raises where the edge has ended; Ray Serve then replaces it.

        The first check starts the edge and waits until it is loaded, and so do the requests, until it has passed.
        """
        if self._serving is None:
            # The event loop does not run yet when the object is made.
            self._serving = asyncio.create_task(self._server.serve(sockets=[self._listener]), name="edge")
        await self._server.gate.opened()
        if self._server.error is not None or self._serving.done():
            raise RuntimeError(f"the edge has ended: {self._server.error}")

    async def __del__(self) -> None:
        # Ray Serve awaits this method, and has no other way to end an edge.
        if self._serving is not None:
            self._server.should_exit = True
            await self._serving


def _application(settings: Settings) -> FastAPI:
    # The ingress imports this module too, and needs no torch.
    from service.api.app import create_app
    from service.storage.store import Store

    return create_app(settings, Store(settings.store))
