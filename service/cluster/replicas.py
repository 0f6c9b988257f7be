"""The owners of missions, ordinary edges with their own addresses, as replicas of a Ray Serve deployment."""

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from functools import partial
from hashlib import blake2b
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, TypeVar

from ray import serve
from ray.exceptions import RayError
from ray.serve.config import AutoscalingConfig, RequestRouterConfig
from ray.serve.exceptions import RayServeException
from ray.serve.schema import LoggingConfig

from service.cluster.exchange import DECIDED_AT, Answer, Exchanged, OwnersGone, answer_of
from service.config.settings import Settings
from service.observability import logs
from service.server.server import Server
from shared.kit.ray_connection import RayUnusable

if TYPE_CHECKING:
    from fastapi import FastAPI

_NAME = "aicvds-"
_ROUTER = "ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"
# The average of concurrent requests for an edge above which another edge is started.
_SCALING = {"target_ongoing_requests": 8.0}
# An edge that is killed is replaced once a health check finds it gone.
_HEALTH_PERIOD_S, _HEALTH_TIMEOUT_S = 1.0, 10.0
# The edge's own end takes up to 9 s.
_SHUTDOWN_S = 15.0
Answered = TypeVar("Answered")


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


def _application(settings: Settings) -> "FastAPI":
    # The ingress imports this module too, and needs no application.
    from service.api.app import create_app
    from service.storage.store import Store

    return create_app(settings, Store(settings.store))


class ServeOwners:
    """The replicas of a deployment, as :class:`service.cluster.ingress.Owners`."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle

    async def ask(self, request: Exchanged, within_s: float) -> Answer:
        return await _in_time(lambda: self._of(request.mission_id).answer.remote(request), within_s)

    async def ask_all(self, request: Exchanged, within_s: float) -> dict[str, Answer]:
        async def found() -> dict[str, Answer]:
            answers = await self._handle.broadcast("named_answer", request).results_async(return_exceptions=True)
            return dict(sorted(answer for answer in answers if not isinstance(answer, BaseException)))

        answers = await _in_time(found, within_s)
        if not answers:
            raise OwnersGone("none")
        return answers

    async def address(self, mission_id: str | None, within_s: float) -> str:
        return await _in_time(lambda: self._of(mission_id).address.remote(), within_s)

    def _of(self, mission_id: str | None) -> Any:
        return self._handle.options(session_id=mission_id or "")


async def _in_time(ask: Callable[[], Awaitable[Answered]], within_s: float) -> Answered:
    try:
        async with asyncio.timeout(within_s):
            return await ask()
    except (RayError, RayServeException, TimeoutError) as error:
        raise OwnersGone(repr(error)) from None


def deployed(settings: Settings, host: str | None, least: int, most: int, **scaling: float) -> ServeOwners:
    """From ``least`` to ``most`` replicas, by load, on the Ray to which this process is connected.

    Replicas that another ingress has started with the same settings are reused.

    Args:
        host: as of :class:`Owner`.
        scaling: other fields of Ray Serve's ``AutoscalingConfig``.

    Raises:
        RayUnusable: there are replicas with other settings, or new ones cannot be loaded.
    """
    logging.getLogger("ray.serve").setLevel(logging.WARNING)
    serve.start(proxy_location="Disabled")
    name = _NAME + _digest(settings, least, most)
    running = {known: app.status for known, app in serve.status().applications.items() if known.startswith(_NAME)}
    if running.keys() - {name}:
        raise RayUnusable(
            "--ray: edges with other settings, or of another release, run on this cluster: "
            "give the same AICVDS_* variables and --replicas, or end them by `serve shutdown`"
        )
    if name in running and running[name] == "RUNNING":
        return ServeOwners(serve.get_app_handle(name))
    deployment: Any = serve.deployment(
        name="owner",
        ray_actor_options={"num_cpus": 1},
        max_ongoing_requests=settings.max_requests,
        health_check_period_s=_HEALTH_PERIOD_S,
        health_check_timeout_s=_HEALTH_TIMEOUT_S,
        graceful_shutdown_timeout_s=_SHUTDOWN_S,
        # The edge has a log of its own.
        logging_config=LoggingConfig(log_level="WARNING", enable_access_log=False),
        autoscaling_config=AutoscalingConfig(min_replicas=least, max_replicas=most, **_SCALING | scaling),
        request_router_config=RequestRouterConfig.model_validate(
            {"request_router_class": _ROUTER, "request_router_kwargs": {"num_fallback_replicas": 0}}
        ),
    )(Owner)
    try:
        return ServeOwners(serve.run(deployment.bind(settings, host), name=name, route_prefix=None))
    except RuntimeError as error:
        raise RayUnusable(f"--ray: {error}") from None


def _digest(settings: Settings, least: int, most: int) -> str:
    """A digest that is the same for ingresses that may share replicas."""
    key = None if settings.llm_api_key is None else settings.llm_api_key.get_secret_value()
    known = settings.model_dump(mode="json", exclude={"llm_api_key", "advertise_url"})
    identity = repr((version("aic-vds"), sorted(known.items()), key, least, most))
    return blake2b(identity.encode(), digest_size=6).hexdigest()


def ended() -> None:
    """End the replicas: they store their missions and release them."""
    serve.shutdown()  # type: ignore[no-untyped-call]
