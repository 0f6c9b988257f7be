"""schemathesis against the app's own OpenAPI: no input gives a 5xx, every answer is as documented."""

from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.api.app import create_app
from service.config.settings import Settings
from tests.support.running import serving

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
_ONLY_POSITIVE = [GenerationMode.POSITIVE]
CASES = [
    (path, method, mode)
    for path, methods in create_app(Settings(mode="value")).openapi()["paths"].items()
    for method, operation in methods.items()
    # A stream of events has no end.
    if not path.endswith("/events")
    # Without a parameter or a body there is nothing to get wrong.
    for mode in (
        list(GenerationMode) if {"parameters", "requestBody"} & operation.keys() else [GenerationMode.POSITIVE]
    )
]


@pytest.fixture(scope="module")
def api() -> Iterator[schemathesis.BaseSchema]:
    with serving(create_app(Settings(mode="value"))) as url:
        yield schemathesis.openapi.from_url(f"{url}/openapi.json")


@pytest.mark.long
@pytest.mark.parametrize(("path", "method", "mode"), CASES)
def test_no_input_breaks_the_edge(api: schemathesis.BaseSchema, path: str, method: str, mode: GenerationMode) -> None:
    strategy = api[path][method].as_strategy(generation_mode=mode)

    @given(case=strategy)
    @settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None)
    def holds(case: schemathesis.Case[Any]) -> None:
        case.call_and_validate(checks=CHECKS)

    holds()
