"""``GET /``, the page, and its data: the list of missions, one mission's events, and a decision's prompt."""

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing, suppress
from functools import lru_cache
from operator import attrgetter
from pathlib import Path

from fastapi import APIRouter, Depends, Request
from fastapi.responses import FileResponse, StreamingResponse
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Scope, Send

from service import live
from service.api.authentication import STILL_KNOWN
from service.api.problem_details import documented
from service.api.routes import TheEngine, may_command, may_know
from service.errors import NotFound
from service.live.broadcaster import Broadcaster
from service.prompting.compact_prompt import in_words
from shared.wire.missions import DecisionPrompt, MissionLine, MissionList
from shared.wire.names import with_names
from shared.wire.reasons import LLM_NOT_ASKED
from shared.wire.schemas import DecisionId, MissionId

router = APIRouter(generate_unique_id_function=attrgetter("name"))

STATIC = Path(live.__file__).parent / "static"
# Only the edge's own files are allowed: no inline scripts or styles, no frames, no requests to other hosts.
_SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; object-src 'none'",
    # The browser validates each time, and gets 304 if nothing changed.
    "Cache-Control": "no-cache",
}
EVENTS = "text/event-stream"
_MOST_LISTED = 200
KEY_CHECK_S = 1.0


class Assets(StaticFiles):
    """The page, its scripts and styles, sent from memory: a slow client keeps no file open."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        if isinstance(response, FileResponse):
            # All clients share one copy of the bytes.
            whole = Response(_content(str(response.path), response.headers["etag"]), media_type=response.media_type)
            whole.headers.update({name: response.headers[name] for name in ("etag", "last-modified")})
            response = whole
        response.headers.update(_SECURITY_HEADERS)
        return response


@lru_cache(maxsize=64)
def _content(path: str, _etag: str) -> bytes:
    """A file of this size and date."""
    return Path(path).read_bytes()


ASSETS = Assets(directory=STATIC)


class EventStream(StreamingResponse):
    """Server-sent events to one listener; they end when it stops reading or its key is removed."""

    media_type = EVENTS

    def __init__(self, live: Broadcaster, events: AsyncGenerator[bytes], still_known: Callable[[], bool]) -> None:
        self._events = self._while_known(events, still_known)
        super().__init__(self._events, headers={"X-Accel-Buffering": "no"})  # Otherwise nginx with gzip sends nothing.
        self._live = live

    async def stream_response(self, send: Send) -> None:
        async def in_time(message: Message) -> None:
            async with self._live.sending():
                await send(message)

        # Closed immediately, so that no events are made for a closed page.
        with suppress(TimeoutError):
            async with aclosing(self._events):
                await super().stream_response(in_time)

    async def _while_known(
        self, events: AsyncGenerator[bytes], still_known: Callable[[], bool]
    ) -> AsyncGenerator[bytes]:
        checked_at = time.monotonic()
        async with aclosing(events):
            async for event in events:
                if time.monotonic() - checked_at > KEY_CHECK_S:
                    if not still_known():
                        return
                    checked_at = time.monotonic()
                yield event


async def _listener(engine: TheEngine) -> AsyncIterator[None]:
    """A listener's slot until the response has ended."""
    with engine.live.listener():
        yield


@router.get("/", include_in_schema=False)
async def page(request: Request) -> Response:
    """The page, without data."""
    return await ASSETS.get_response("index.html", request.scope)


@router.get("/missions", tags=["missions"])
async def list_missions(engine: TheEngine, request: Request) -> MissionList:
    """The missions of this edge: the one that decided last first, those that are only in the store last.

    In a shared store, other edges' missions are left out.
    """
    missions = engine.missions
    loaded = {mission.mission_id: mission for mission in missions.loaded}
    lately = [name for name in engine.live.history.missions() if name in loaded]
    names = [name for name in dict.fromkeys((*lately, *reversed(loaded), *missions.stored)) if may_know(request, name)]
    lines = []
    for name in names[:_MOST_LISTED]:
        mission = loaded.get(name)
        if mission is None:
            lines.append(MissionLine(mission_id=name))
        else:
            lines.append(MissionLine(mission_id=name, mode=mission.mode, decisions=mission.decisions))
    return MissionList(
        missions=lines,
        more=max(0, len(names) - _MOST_LISTED),
        newest=names[0] if names and names[0] in lately else None,
        may_command=may_command(request),
    )


@router.get(
    "/missions/{mission_id}/events",
    status_code=200,
    response_class=EventStream,
    responses={200: {"content": {EVENTS: {"schema": {"type": "string"}}}}, **documented(404, 421, 422, 503)},
    tags=["missions"],
    dependencies=[Depends(_listener)],
)
async def events(mission_id: MissionId, engine: TheEngine, request: Request) -> EventStream:
    """A mission's events: ``snapshot``, then ``update`` at most ten times a second; ``gone`` if it is deleted.

    :mod:`service.live.snapshots` makes them. Comments are sent while there are no events; a slow listener gets a
    snapshot.
    """
    mission = await engine.missions.get(mission_id)
    still_known: Callable[[], bool] = request.scope.get(STILL_KNOWN, lambda: True)
    return EventStream(engine.live, engine.live.events(mission), still_known)


@router.get("/missions/{mission_id}/decisions/{decision_id}/prompt", responses=documented(404, 422), tags=["decisions"])
async def get_prompt(mission_id: MissionId, decision_id: DecisionId, engine: TheEngine) -> DecisionPrompt:
    """A decision's prompt; only those of the newest decisions are kept, and a restart drops them."""
    decision = engine.live.history.find(mission_id, decision_id)
    if decision is None or decision.prompt is None:
        raise NotFound("decision_id", f"the prompt of decision {decision_id} is unknown or forgotten")
    prompt, mission = decision.prompt, await engine.missions.get(mission_id)
    words = []
    # A decision without candidates has another prompt, which begins with no digit.
    if mission.spec.prompt.format == "compact" and prompt.state[:1].isdigit():
        words = in_words(prompt.state, [kept.sensor_id for kept in decision.answer.top_k], mission.scenario)
    return DecisionPrompt(
        decision_id=decision_id,
        asked=decision.answer.reason not in LLM_NOT_ASKED,
        static=prompt.static,
        experiences=prompt.experiences,
        state=prompt.state,
        in_words=[with_names(line, mission.spec.names) for line in words],
    )


def compressed(app: ASGIApp) -> ASGIApp:
    """The application, whose answers of 1 kB and more are compressed for clients that accept gzip."""
    return GZipMiddleware(app, minimum_size=1000)


for _route in router.routes:
    if isinstance(_route, APIRoute) and _route.path in ("/", "/missions"):
        _route.app = compressed(_route.app)
