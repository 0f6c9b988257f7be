"""Faults are in plain words: no regular expression, and no word of pydantic's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel

from field.lorawan.configuration import Configuration
from service.api.api_keys import KeyFile
from service.config.settings import Settings
from shared.kit.validation_messages import _PATTERNS, problem_of
from shared.wire.readings import ReadingsRequest
from shared.wire.schemas import BatchRequest, DecideRequest, FeedbackRequest, MissionSpec

MODELS = (Configuration, KeyFile, Settings, ReadingsRequest, BatchRequest, DecideRequest, FeedbackRequest, MissionSpec)


def patterns(schema: Any) -> Iterator[str]:
    if isinstance(schema, dict) and isinstance(schema.get("pattern"), str):
        yield schema["pattern"]
    for part in schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ():
        yield from patterns(part)


@pytest.mark.parametrize("model", MODELS)
def test_every_pattern_of_a_field_has_words(model: type[BaseModel]) -> None:
    found = set(patterns(model.model_json_schema()))
    assert found and found <= set(_PATTERNS)


def test_a_pattern_without_words_is_shown() -> None:
    error = {"type": "string_pattern_mismatch", "msg": "String should match pattern 'x'", "ctx": {"pattern": "x"}}
    assert problem_of(error) == "must match pattern 'x'"
