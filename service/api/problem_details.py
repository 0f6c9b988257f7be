"""Errors as RFC 9457 problem documents that name the field at fault."""

import logging
import math
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from service.errors import Misdirected, Refused, Unavailable
from shared.kit.validation_messages import problem_of
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import End, Guidance, SensorWish
from shared.wire.problem import Fault, Problem
from shared.wire.readings import ReadingsRequest, SensorReading
from shared.wire.schemas import BatchRequest, DecideRequest, FeedbackRequest, MissionSpec, PromptStyle, SensorColumns
from shared.world.scenario import Scenario

log = logging.getLogger(__name__)

# pydantic's names for the branches of a union, which are not fields.
_UNION_TAGS = ("constrained-", "function-")

CONTENT_TYPE = "application/problem+json"
# The name of a real field is shorter; a longer one is the client's text, which is not sent back.
_MOST_NAME = 80
_REQUESTS = (
    *(BatchRequest, DecideRequest, FeedbackRequest, SensorColumns),
    *(MissionSpec, PromptStyle, Scenario, GuidanceAnswer, Guidance, SensorWish, End),
    *(ReadingsRequest, SensorReading),
)
# The names of all request fields, for suggestions for unknown names.
_NAMES = sorted({name for model in _REQUESTS for name in model.model_fields})
# The `Retry-After` of a request that cannot be served now.
_RETRY_S = 1


def problem_response(
    status: int, detail: str, errors: Sequence[dict[str, str]] = (), kind: str = "about:blank", owner: str | None = None
) -> Response:
    """An ``application/problem+json`` response of the type ``kind``, which never repeats the request's content."""
    faults = [Fault(**error) for error in errors]
    body = Problem(type=kind, title=HTTPStatus(status).phrase, status=status, detail=detail, errors=faults, owner=owner)
    return Response(body.model_dump_json(), status_code=int(status), media_type=CONTENT_TYPE)


def refusal_of(error: Refused) -> Response:
    """The problem of a refusal."""
    return problem_response(error.status, str(error), [{"field": error.field, "problem": error.detail}], error.type)


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries for the problems of a route."""
    # Each status needs its own dicts, because its example is added to them.
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {CONTENT_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status in statuses
    }


def install(app: FastAPI) -> None:
    """Turn every error of the app into a problem document."""

    @app.exception_handler(Refused)
    async def refused(request: Request, error: Refused) -> Response:
        if isinstance(error, Misdirected):
            return _misdirected(request, error)
        response = refusal_of(error)
        if isinstance(error, Unavailable):
            response.headers["Retry-After"] = str(_RETRY_S)
        return response

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        # The deepest fault comes first: it belongs to the best-fitting branch of a union.
        faults = sorted(error.errors()[:20], key=lambda e: -len(e["loc"]))
        if not _sends_json(request) and _path(faults[0]["loc"]) == "body":
            return problem_response(415, "send the body as JSON, with the header Content-Type: application/json")
        errors = [{"field": _path(e["loc"]), "problem": _problem(e, error.body)} for e in faults]
        return problem_response(422, f"{errors[0]['field']}: {errors[0]['problem']}", errors)

    @app.exception_handler(HTTPException)
    async def http(_: Request, error: HTTPException) -> Response:
        detail = "is not UTF-8" if isinstance(error.__cause__, UnicodeDecodeError) else str(error.detail)
        faults = [{"field": "body", "problem": detail}] if error.status_code == 400 else []
        response = problem_response(error.status_code, f"body: {detail}" if faults else detail, faults)
        response.headers.update(error.headers or {})
        return response

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> Response:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return problem_response(500, "the edge failed; its log has the details")


def _misdirected(request: Request, error: Misdirected) -> Response:
    """A 421 with the request's address at the owner, and the seconds after which any edge may take the mission over."""
    faults = [{"field": error.field, "problem": error.detail}]
    response = problem_response(error.status, str(error), faults, error.type, error.owner)
    if error.owner is not None:
        query = f"?{request.url.query}" if request.url.query else ""
        response.headers["Location"] = f"{error.owner}{quote(request.url.path)}{query}"
    response.headers["Retry-After"] = str(max(_RETRY_S, math.ceil(error.retry_s)))
    return response


def _sends_json(request: Request) -> bool:
    """Whether the request says that its body is JSON."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    return kind == "application/json" or (kind.startswith("application/") and kind.endswith("+json"))


def _problem(fault: Mapping[str, Any], body: Any) -> str:
    """A fault in words, with the line and column for a body that is not JSON."""
    if fault["type"] != "json_invalid":
        return problem_of(fault, _NAMES)
    reason = str(fault.get("ctx", {}).get("error", "it cannot be read"))
    at = fault["loc"][-1]
    if not isinstance(body, str) or not isinstance(at, int):
        return f"is no JSON: {reason}"
    before = body[:at]
    return f"is no JSON: {reason}, line {before.count(chr(10)) + 1}, column {at - before.rfind(chr(10))}"


def _path(location: Sequence[int | str]) -> str:
    location = [p for p in location if not (isinstance(p, str) and p.startswith(_UNION_TAGS))]
    parts = list(location[1:]) if location and location[0] in ("body", "path", "query", "header") else list(location)
    # A JSON syntax error has the byte offset for a location.
    if not parts or (len(parts) == 1 and isinstance(parts[0], int)):
        return "body"
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in parts).removeprefix(".")[:_MOST_NAME]
