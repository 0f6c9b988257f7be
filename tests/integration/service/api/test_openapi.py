"""OpenAPI: every request and answer has an example, and a real edge and the schema agree with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jsonschema_rs
import pytest

from service.api.app import create_app
from service.api.openapi import ANSWERS, REQUESTS
from service.config.settings import Settings
from tests.conftest import Edge

DOCUMENT = create_app(Settings(mode="value")).openapi()
OPERATIONS = [(method, path) for path, methods in DOCUMENT["paths"].items() for method in methods]
Json = Any


def contents(operation: Json) -> Iterator[tuple[str, Json]]:
    """What an operation takes and gives, with its schema and its examples."""
    for name, content in operation.get("requestBody", {}).get("content", {}).items():
        yield f"request {name}", content
    for status, response in operation["responses"].items():
        for name, content in response.get("content", {}).items():
            yield f"{status} {name}", content


def values(content: Json) -> list[Json]:
    """A content's examples."""
    one = [content["example"]] if "example" in content else []
    return one + [example["value"] for example in content.get("examples", {}).values()]


def check(schema: Json, value: Json) -> None:
    jsonschema_rs.validator_for({**schema, "components": DOCUMENT["components"]}).validate(value)


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_every_content_has_an_example_that_its_schema_takes(method: str, path: str) -> None:
    for name, content in contents(DOCUMENT["paths"][path][method]):
        # /metrics is text.
        if "json" in name:
            assert values(content), f"{method} {path}: {name} has no example"
        for value in values(content):
            check(content["schema"], value)


def test_answers_may_have_further_fields_and_requests_may_not() -> None:
    """A client that is made from this document must take the answers of a later edge."""
    schemas = DOCUMENT["components"]["schemas"]
    closed = {name for name, schema in schemas.items() if schema.get("additionalProperties") is False}
    assert closed >= {"DecideRequest", "BatchRequest", "Outcome", "MissionSpec", "ReadingsRequest", "Guidance"}
    assert not closed & {"DecideResponse", "Tokens", "FeedbackResponse", "MissionStatus", "GuidanceStatus", "Readiness"}


def test_what_is_asked_for_a_key_says_so() -> None:
    refusals = {
        f"{method} {path}": sorted({"401", "403", "429"} & DOCUMENT["paths"][path][method]["responses"].keys())
        for method, path in OPERATIONS
    }
    assert refusals["get /healthz"] == refusals["get /readyz"] == []
    # Any key may read, where it is bound to the mission; deciding, and making missions, takes a scope.
    assert refusals["get /missions/{mission_id}"] == ["401", "429"]
    assert refusals["post /decide"] == refusals["put /missions/{mission_id}"] == ["401", "403", "429"]
    asking = {f"{method} {path}" for method, path in OPERATIONS if "security" in DOCUMENT["paths"][path][method]}
    assert asking == {route for route, statuses in refusals.items() if statuses}
    assert DOCUMENT["components"]["securitySchemes"]["key"]["scheme"] == "bearer"


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_a_problems_example_has_its_own_status(method: str, path: str) -> None:
    for status, response in DOCUMENT["paths"][path][method]["responses"].items():
        for value in values(response.get("content", {}).get("application/problem+json", {})):
            assert value["status"] == int(status)


def test_the_schema_refuses_what_is_no_example() -> None:
    content = DOCUMENT["paths"]["/decide"]["post"]["requestBody"]["content"]["application/json"]
    with pytest.raises(jsonschema_rs.ValidationError):
        check(content["schema"], {**values(content)[0], "step": -1})


DECISION_ID = ANSWERS["post /decide"]["decision_id"]


def reported(value: Json, decision_id: str) -> Json:
    """An example with the id of a decision that there is."""
    if isinstance(value, dict):
        return {key: reported(inner, decision_id) for key, inner in value.items()}
    return decision_id if value == DECISION_ID else value


def test_a_real_edge_takes_every_example_and_answers_as_the_examples_do(edge: Edge) -> None:
    http = edge()
    decision_id = DECISION_ID
    # A mission before its guidance, a decision before its outcome.
    for route in sorted(REQUESTS, key=lambda route: (not route.startswith("put"), route)):
        method, path = route.split()
        for name, example in REQUESTS[route].items():
            mission_id = name if method == "put" else "preset"
            answer = http.request(
                method, path.format(mission_id=mission_id), json=reported(example["value"], decision_id)
            )
            assert answer.status_code == 200, f"{method} {path}, example {name}: {answer.text}"
            # A status has names where the mission was given some.
            named = {"names"} & example["value"].keys()
            assert answer.json().keys() == ANSWERS[route].keys() | named
            if path == "/decide" and name in ("paper", "held"):
                decision_id = answer.json()["decision_id"]
    for route, expected in ANSWERS.items():
        method, path = route.split()
        if method == "get":
            mission_id = "default" if "decision_id" in path else "preset"
            answer = http.get(path.format(mission_id=mission_id, decision_id=decision_id))
            assert answer.status_code == 200
            assert answer.json().keys() == expected.keys()
            check(
                DOCUMENT["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"],
                answer.json(),
            )
