"""The text of an edge's refusal."""

from __future__ import annotations

import pytest

from shared.client.errors import EdgeRefused
from shared.wire.problem import Problem

FAULT = {"field": "mission_id", "problem": "there is no mission x"}


@pytest.mark.parametrize(
    ("detail", "text"),
    [
        ("mission_id: there is no mission x", "mission_id: there is no mission x"),
        ("1 field is invalid", "1 field is invalid (mission_id: there is no mission x)"),
    ],
)
def test_a_refusal_names_each_fault_once(detail: str, text: str) -> None:
    problem = Problem.model_validate({"title": "Not Found", "status": 404, "detail": detail, "errors": [FAULT]})
    assert str(EdgeRefused("http://edge/decide", problem, 404)) == f"http://edge/decide refused with 404: {text}"
