"""Examples for the OpenAPI document: of every request, every answer and every problem, from openapi_examples.json."""

from __future__ import annotations

import json
from http import HTTPStatus
from importlib.resources import files
from typing import Any

from shared.wire.problem import Problem
from shared.world.scenario import SCENARIOS

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
        errors=[{"field": field, "problem": fault}] if field else [],
        owner="http://edge-2:8000" if status == HTTPStatus.MISDIRECTED_REQUEST else None,
    )
    return whole.model_dump(mode="json")
