"""The OpenAPI document: FastAPI's, with problem documents for errors and an example of every request and answer."""

import json
from http import HTTPStatus
from importlib.resources import files
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.api.authentication import is_open, scope_of
from service.api.problem_details import CONTENT_TYPE, documented
from shared.wire.problem import Fault, Problem
from shared.world.scenario import SCENARIOS

JSON = "application/json"

_KEYS = "Asked for where the edge was given keys (AICVDS_KEYS)."

Example = dict[str, Any]


def _read() -> Example:
    """The file's content, with the scenario of each mission in full."""
    content: Example = json.loads(files("service.api").joinpath("openapi_examples.json").read_text(encoding="utf-8"))
    for answer in content["answers"].values():
        if "scenario" in answer:
            answer["scenario"] = SCENARIOS[answer["scenario"]].model_dump(mode="json")
    return content


_EXAMPLES = _read()
# By method and path, such as `post /decide`; the request that the paper's UAV would send comes first.
REQUESTS: dict[str, dict[str, Example]] = _EXAMPLES["requests"]
# Of the answers with status 200.
ANSWERS: dict[str, Any] = _EXAMPLES["answers"]


def problem(status: int) -> Example:
    """A problem document of that status."""
    field, fault = _EXAMPLES["problems"][str(status)]
    whole = Problem(
        title=HTTPStatus(status).phrase,
        status=status,
        detail=f"{field}: {fault}" if field else fault,
        errors=[Fault(field=field, problem=fault)] if field else [],
        owner="http://edge-2:8000" if status == HTTPStatus.MISDIRECTED_REQUEST else None,
    )
    return whole.model_dump(mode="json")


def schema_of(app: FastAPI) -> dict[str, Any]:
    """The app's OpenAPI document; made once."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = schema["components"]["schemas"]
        problem_schema = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas |= problem_schema.pop("$defs") | {"Problem": problem_schema}
        for unused in ("HTTPValidationError", "ValidationError"):
            schemas.pop(unused, None)
        schema["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer", "description": _KEYS}}
        for path, methods in schema["paths"].items():
            for method, operation in methods.items():
                _add_security(operation, method.upper(), path)
                _add_examples(operation, f"{method} {path}")
        app.openapi_schema = schema
    return app.openapi_schema


def _add_security(operation: dict[str, Any], method: str, path: str) -> None:
    """Add the key that ``KeyAuthentication`` requires where the edge has keys, and its refusals."""
    if is_open(method, path):
        return
    operation["security"] = [{"key": []}, {}]
    refusals = [403] if scope_of(method, path) else []
    # A key that is bound to other missions.
    refusals += [404] if path.startswith("/missions/") else []
    responses = operation["responses"] | {str(s): one for s, one in documented(401, 429, *refusals).items()}
    operation["responses"] = dict(sorted(responses.items()))


def _add_examples(operation: dict[str, Any], route: str) -> None:
    if route in REQUESTS:
        operation["requestBody"]["content"][JSON]["examples"] = REQUESTS[route]
    for status, response in operation["responses"].items():
        content = response.get("content", {})
        if JSON in content and route in ANSWERS:
            content[JSON]["example"] = ANSWERS[route]
        if CONTENT_TYPE in content:
            content[CONTENT_TYPE]["example"] = problem(int(status))
