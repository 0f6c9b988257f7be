"""The HTTP interface: thin routes over the engine."""

import asyncio
import re
from collections.abc import Callable, Coroutine
from functools import partial
from operator import attrgetter
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import ValidationError

from service.api.api_keys import ApiKey, ApiKeys
from service.api.authentication import KEY, no_mission
from service.api.mission_answers import attention_response, status_of
from service.api.problem_details import documented
from service.edge.engine import Engine
from service.live.alarms import KINDS
from service.llm.server_pool import ServerPool
from service.observability.metrics import Metrics
from shared.planning.guidance_messages import GuidanceAnswer, GuidanceStatus
from shared.wire.missions import MissionAttention, MissionStatus
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.schemas import (
    BatchRequest,
    BatchResponse,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    MissionId,
    MissionSpec,
    Readiness,
)

# The statuses of refusals: of a request that names a mission, and of one that also has a body.
_NAMED = (404, 409, 421, 422, 503)
_SENT = (400, 404, 408, 409, 413, 415, 421, 422, 503)
_KEY, _KEY_PATTERN = "Idempotency-Key", re.compile(r"[\x21-\x7e]{1,64}")


class DecideRoute(APIRoute):
    """``POST /decide``: it validates a well-formed request itself, from the bytes.

    FastAPI's own handling takes several times as long as validating the body. It handles all other requests, and
    reports their errors.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The route's handler, made once."""
        general = super().get_route_handler()

        async def handler(request: Request) -> Response:
            if (key := request.headers.get(_KEY)) is not None and _KEY_PATTERN.fullmatch(key) is None:
                return await general(request)
            if request.headers.get("Content-Type") != "application/json":
                return await general(request)
            try:
                body = DecideRequest.model_validate_json(await request.body())
            except ValidationError as error:
                faults = error.errors(include_url=False)
                if faults[0]["type"] == "json_invalid":
                    return await general(request)
                # It is validated once: a large body takes long.
                raise RequestValidationError([{**f, "loc": ("body", *f["loc"])} for f in faults]) from None
            return await decide(body, request, key)

        return handler


# Clients made from the schema have functions of the routes' names.
router = APIRouter(generate_unique_id_function=attrgetter("name"))
decisions = APIRouter(route_class=DecideRoute, generate_unique_id_function=attrgetter("name"))


async def _engine(request: Request) -> Engine:
    engine: Engine = request.state.engine
    return engine


def may_command(request: Request) -> bool:
    """Whether the request may make, guide and delete missions: with keys, only scope ``admin`` may."""
    key: ApiKey | None = request.scope.get(KEY)
    return key is None or "admin" in key.scopes


def may_know(request: Request, mission_id: str) -> bool:
    """Whether the request's key is for a mission; for any other the answer is that there is none."""
    key: ApiKey | None = request.scope.get(KEY)
    return key is None or key.allows(mission_id)


def _refuse_unless_bound(request: Request, mission_id: str) -> None:
    if not may_know(request, mission_id):
        raise no_mission(request.scope[KEY], mission_id)


def _keys_lost(request: Request) -> bool:
    keys: ApiKeys | None = request.state.keys
    return keys is not None and keys.lost


TheEngine = Annotated[Engine, Depends(_engine)]
RequestKey = Annotated[
    str | None,
    Header(
        alias=_KEY,
        pattern=f"^{_KEY_PATTERN.pattern}$",
        description="a request that is sent again under the same key gets the same answer, after a restart too; of any "
        "mission the newest eight a UAV are remembered",
    ),
]

KnownTags = Annotated[str | None, Header(alias="If-None-Match", max_length=1000, description="ETags of what is held")]


@decisions.post("/decide", response_model=DecideResponse, responses=documented(*_SENT), tags=["decisions"])
async def decide(body: DecideRequest, request: Request, key: RequestKey = None) -> Response:
    """The sensor to collect from, and the velocity of the next step."""
    _refuse_unless_bound(request, body.mission_id)
    engine: Engine = request.state.engine
    answer = await engine.decide(body, may_make=may_command(request), key=key)
    timing = {"Server-Timing": ", ".join(f"{k};dur={v}" for k, v in answer.latency_ms.items())}
    # The response is text already, because FastAPI would validate and convert the model a second time.
    return Response(answer.model_dump_json(), media_type="application/json", headers=timing)


@router.post("/decide/batch", responses=documented(*_SENT), tags=["decisions"])
async def decide_batch(
    body: BatchRequest, request: Request, engine: TheEngine, key: RequestKey = None
) -> BatchResponse:
    """A fleet's UAVs at one step, decided in the order given; no sensor is given to two of them."""
    _refuse_unless_bound(request, body.mission_id)
    return BatchResponse(decisions=await engine.decide_batch(body, may_make=may_command(request), key=key))


@router.post("/feedback", responses=documented(*_SENT), tags=["decisions"])
async def feedback(body: FeedbackRequest, request: Request, engine: TheEngine) -> FeedbackResponse:
    """A decision's outcome. A repeated outcome is applied once; an acknowledged outcome is on disk."""
    if body.mission_id is not None:
        _refuse_unless_bound(request, body.mission_id)
    return await engine.feedback(body, partial(may_know, request))


@router.put("/missions/{mission_id}", responses=documented(400, 408, 409, 413, 415, 421, 422, 503), tags=["missions"])
async def put_mission(mission_id: MissionId, body: MissionSpec, engine: TheEngine) -> MissionStatus:
    """Make a mission with its scenario, mode, k and the operator's note; a repeated request changes nothing."""
    mission = await engine.missions.put(mission_id, body)
    engine.compiler.compile(mission)
    await engine.durable("mission_id", mission)
    return status_of(mission)


@router.get("/missions/{mission_id}", responses=documented(*_NAMED), tags=["missions"])
async def get_mission(mission_id: MissionId, engine: TheEngine) -> MissionStatus:
    """A mission's setup, progress and alarms."""
    mission = await engine.missions.get(mission_id)
    alarming = {kind: whose for kind, whose in engine.live.watch.alarms_of(mission).items() if whose}
    return status_of(mission).model_copy(update={"alarms": alarming or None})


@router.delete("/missions/{mission_id}", status_code=204, responses=documented(*_NAMED), tags=["missions"])
async def delete_mission(mission_id: MissionId, engine: TheEngine) -> None:
    """Delete a mission and everything it learned."""
    await engine.delete(mission_id)


@router.get(
    "/missions/{mission_id}/attention",
    response_model=MissionAttention,
    responses={304: {"description": "the same as `If-None-Match` names"}, **documented(*_NAMED)},
    tags=["missions"],
)
async def get_attention(
    mission_id: MissionId, engine: TheEngine, request: Request, known_tags: KnownTags = None
) -> Response:
    """The attention module's weights, with an ETag: to score the sensors on board, and report only the k best."""
    mission = await engine.missions.get(mission_id)
    return attention_response(mission, known_tags, request.headers.get("Accept-Encoding", ""))


@router.get("/missions/{mission_id}/guidance", responses=documented(*_NAMED), tags=["missions"])
async def get_guidance(mission_id: MissionId, engine: TheEngine) -> GuidanceStatus:
    """The operator's note, the guidance from it, and its status; only confirmed guidance is obeyed."""
    return (await engine.missions.get(mission_id)).report_guidance()


@router.post("/missions/{mission_id}/guidance", responses=documented(*_SENT), tags=["missions"])
async def post_guidance(mission_id: MissionId, body: GuidanceAnswer, engine: TheEngine) -> GuidanceStatus:
    """Confirm or reject the proposed guidance, give a structure or a new note, or withdraw orders in force.

    Only confirmed orders are obeyed. They are added, unless they replace all; the status shows what either would end.
    """
    mission = await engine.missions.get(mission_id)
    if body.answer != "withdraw":
        engine.missions.refuse_if_failing("answer")
    mission.answer_guidance(body)
    engine.compiler.compile(mission)
    engine.live.changed(mission_id)
    await engine.durable("answer", mission)
    return mission.report_guidance()


@router.post("/missions/{mission_id}/readings", responses=documented(*_SENT), tags=["missions"])
async def post_readings(mission_id: MissionId, body: ReadingsRequest, engine: TheEngine) -> ReadingsResponse:
    """Sensors' own readings over another network, merged into the fleet's belief by their age."""
    return await engine.read(mission_id, body)


@router.get("/healthz", tags=["operation"])
async def healthz() -> dict[str, str]:
    """The process is alive; nothing else is checked."""
    return {"status": "ok"}


@router.get("/readyz", responses={503: {"model": Readiness, "description": "not ready"}}, tags=["operation"])
async def readyz(request: Request, response: Response) -> Readiness:
    """Whether the edge can decide: by the policy immediately, by the LLM when ``llm`` is ``ready``.

    An edge is not ready (503) if it cannot reach the PostgreSQL that it shares with other edges, or if its SQLite file
    was deleted, replaced, damaged or changed by another program; ``detail`` has the reason.
    """
    llm: ServerPool = request.state.llm
    engine: Engine = request.state.engine
    readiness = llm.readiness()
    if _keys_lost(request):
        readiness = readiness.model_copy(update={"detail": "the file of keys cannot be read: the previous keys apply"})
    if (fault := engine.missions.fault) is None:
        return readiness
    response.status_code = 503
    return readiness.model_copy(update={"ready": False, "detail": fault})


@router.get("/metrics", tags=["operation"], response_class=Response)
async def metrics(request: Request) -> Response:
    """Prometheus metrics, as OpenMetrics where the request's Accept header names it."""
    owned: Metrics = request.state.metrics
    owned.tasks.set(len(asyncio.all_tasks()))
    llm: ServerPool = request.state.llm
    owned.keys_lost.set(_keys_lost(request))
    owned.record_llm(llm.statuses, llm.breakers_open)
    engine: Engine = request.state.engine
    found = engine.live.watch.alarms(engine.missions.loaded)
    for kind in KINDS:
        owned.alarms.labels(kind).set(found[kind])
    content, content_type = owned.exposed(request.headers.get("accept", ""))
    return Response(content, headers={"Content-Type": content_type})
