"""``aicvds serve --ray``: the ingress in this process forwards each request to the edge that owns its mission."""

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Protocol

import httpx
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.middleware import Middleware
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.types import Receive, Scope, Send

from service.api.authentication import KnownHosts
from service.api.problem_details import problem_response
from service.api.request_limits import RequestLimits
from service.cluster.exchange import Answer, Exchanged, OwnersGone, merged_metrics, merged_missions, merged_readiness
from service.config.settings import Settings
from service.server.middleware import SecurityHeaders
from service.server.server import Server
from shared.kit.bounded import BoundedDict
from shared.kit.ray_connection import LOCAL, RayUnusable, connected

log = logging.getLogger(__name__)

# An edge answers within the deadline and 50 ms.
_SLACK_S = 0.2
_CONNECT_S = 1.0
_REMEMBERED = 10_000
_LOOPBACK = "127.0.0.1"
# Headers of one connection, which are not forwarded.
_OF_A_CONNECTION = frozenset((b"connection", b"content-length", b"date", b"host", b"server", b"transfer-encoding"))
_WHOLE_EDGE = frozenset((("GET", "/metrics"), ("GET", "/readyz"), ("GET", "/missions")))


class Owners(Protocol):
    """The edges of a cluster; each method raises :class:`OwnersGone` if there is no answer in time."""

    async def ask(self, request: Exchanged, within_s: float) -> Answer:
        """The answer of the edge to which the mission's ID maps; of any edge without a mission."""

    async def ask_all(self, request: Exchanged, within_s: float) -> dict[str, Answer]:
        """The answers of the edges by address; at least one."""

    async def address(self, mission_id: str | None, within_s: float) -> str:
        """The URL of the edge to which the mission's ID maps."""


class Ingress:
    """An ASGI application; the edge's middleware has bounded the bodies.

    A mission's ID maps to an edge. If another edge has the mission's lease, as after a change of their number, the
    ingress forwards the request to its address, and remembers it as the owner.
    """

    def __init__(self, owners: Owners, client: httpx.AsyncClient, deadline_s: float) -> None:
        self._owners = owners
        self._client = client
        self._deadline_s = deadline_s
        self._moved = BoundedDict[str, str](_REMEMBERED)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = await Exchanged.read(scope, receive)
        within_s = request.deadline_s(self._deadline_s) + _SLACK_S
        try:
            async with asyncio.timeout(within_s):
                response = await self._response(request, within_s)
        except (OwnersGone, TimeoutError, httpx.HTTPError) as error:
            log.warning("%s %s: no edge answers: %r", scope["method"], scope["path"], error)
            response = problem_response(503, "the edge that is to answer is away: send the request again")
            response.headers["Retry-After"] = "1"
        await response(scope, receive, send)

    def hurry(self) -> None:
        """Do nothing: the edges finish the requests in progress."""

    async def _response(self, request: Exchanged, within_s: float) -> Response:
        if request.asks_for_events:
            return await self._events(request, await self._owners.address(request.mission_id, within_s))
        if (request.scope["method"], request.scope["path"]) in _WHOLE_EDGE:
            return _merged(request.scope["path"], await self._owners.ask_all(request, within_s))
        if request.lacks_mission:
            answers = await self._owners.ask_all(request, within_s)
            return _passed_on(min(answers.values(), key=lambda answer: (answer.status >= 300, answer.status == 404)))
        return _passed_on(await self._answer(request, within_s))

    async def _answer(self, request: Exchanged, within_s: float) -> Answer:
        mission_id = request.mission_id
        if mission_id is not None and (moved := self._moved.get(mission_id)) is not None:
            try:
                answer = await self._forward(request, moved)
                if answer.status != 421:
                    return answer
                self._moved.take(mission_id)
            except httpx.TransportError as error:
                self._moved.take(mission_id)
                # The edge may have made the decision, so only the client can decide whether to repeat the request.
                if not isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
                    raise
        answer = await self._owners.ask(request, within_s)
        owner = _owner_in(answer)
        if owner is None or mission_id is None:
            return answer
        answer = await self._forward(request, owner)
        if answer.status != 421:
            self._moved[mission_id] = owner
        return answer

    async def _forward(self, request: Exchanged, owner: str) -> Answer:
        answer = await self._sent(request, owner)
        try:
            body = b"".join([chunk async for chunk in answer.aiter_raw()])
        finally:
            await answer.aclose()
        return Answer(answer.status_code, [*_kept(answer), (b"content-length", b"%d" % len(body))], body)

    async def _events(self, request: Exchanged, owner: str) -> Response:
        """The owner's stream, until the listener disconnects."""
        answer = await self._sent(request, owner)
        if answer.status_code == 421:
            await answer.aclose()
            answer = await self._sent(request, _origin(answer.headers["location"]))
        response = StreamingResponse(answer.aiter_raw(), answer.status_code, background=BackgroundTask(answer.aclose))
        response.raw_headers = _kept(answer)
        return response

    async def _sent(self, request: Exchanged, owner: str) -> httpx.Response:
        scope: dict[str, Any] = request.scope
        target = scope["raw_path"] + (b"?" + scope["query_string"] if scope["query_string"] else b"")
        headers = [(name, value) for name, value in scope["headers"] if name not in _OF_A_CONNECTION]
        url = httpx.URL(owner).copy_with(raw_path=target)
        sent = self._client.build_request(scope["method"], url, headers=headers, content=request.body)
        return await self._client.send(sent, stream=True)


def _merged(path: str, answers: dict[str, Answer]) -> Response:
    """One answer for all edges; if all refuse the request, the first refusal."""
    if path == "/readyz":
        return merged_readiness(answers.values())
    good = {name: answer for name, answer in answers.items() if answer.status == 200}
    if not good:
        return _passed_on(next(iter(answers.values())))
    return merged_metrics(good) if path == "/metrics" else merged_missions(good.values())


def _passed_on(answer: Answer) -> Response:
    response = Response(answer.body, answer.status)
    response.raw_headers = answer.headers
    return response


def _kept(answer: httpx.Response) -> list[tuple[bytes, bytes]]:
    return [(name.lower(), value) for name, value in answer.headers.raw if name.lower() not in _OF_A_CONNECTION]


def _owner_in(answer: Answer) -> str | None:
    """The owner that a 421 names."""
    location = answer.header("location") if answer.status == 421 else None
    return None if location is None else _origin(location)


def _origin(url: str) -> str:
    return str(httpx.URL(url).copy_with(raw_path=b"/")).rstrip("/")


def ingress_application(settings: Settings, owners: Owners, end: Callable[[], None]) -> Starlette:
    """The ingress's application; ``end`` is called in a thread when it has ended."""

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        limits = httpx.Limits(max_connections=settings.max_requests)
        timeout = httpx.Timeout(None, connect=_CONNECT_S)
        async with httpx.AsyncClient(limits=limits, timeout=timeout, trust_env=False) as client:
            app.state.engine = Ingress(owners, client, settings.deadline_ms / 1e3)
            yield
        await asyncio.to_thread(end)

    async def alive(_: Any) -> Response:
        return JSONResponse({"status": "ok"})

    async def failed(_: Any, error: Exception) -> Response:
        log.error("the ingress failed", exc_info=error)
        return problem_response(500, "the edge failed; its log has the details")

    async def passed_on(scope: Scope, receive: Receive, send: Send) -> None:
        await app.state.engine(scope, receive, send)

    app = Starlette(
        routes=[Route("/healthz", alive), Mount("/", passed_on)],
        lifespan=lifespan,
        exception_handlers={Exception: failed},
        middleware=[
            Middleware(SecurityHeaders),
            Middleware(KnownHosts, settings=settings),
            Middleware(RequestLimits, most=settings.max_requests, limit=settings.max_body_bytes),
        ],
    )
    return app


def serve_cluster(listener: socket.socket, settings: Settings, ray: str, least: int, most: int) -> Server:
    """Serve until SIGTERM or Ctrl-C; returns the server, whose ``error`` is the reason of a failure.

    There are ``least`` to ``most`` replicas, by load. Replicas on a Ray that was started here end with it; those on a
    cluster continue, because other ingresses may use them. If they cannot start, ``error`` is a :class:`RayUnusable`.

    Raises:
        RayUnusable: Ray is not installed, or not at that address.
    """

    def load() -> Starlette:
        # Ray reads its settings when it is imported, so this comes after the connection.
        try:
            from service.cluster.replicas import deployed, ended
        except ModuleNotFoundError as missing:
            raise RayUnusable(
                f"--ray: {missing.name} is not installed. Install the extra: pip install 'aic-vds[ray]'"
            ) from None

        owners = deployed(settings, _LOOPBACK if ray == LOCAL else None, least, most)
        return ingress_application(settings, owners, ended if ray == LOCAL else lambda: None)

    with connected(ray, most):
        server = Server(load, settings.log_level)
        # At a signal, uvicorn ends the process after the application.
        server.run(sockets=[listener])
    return server
