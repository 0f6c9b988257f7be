"""The digest of a request under an idempotency key."""

from __future__ import annotations

import asyncio
import hashlib
from typing import Any

import pytest

from service.errors import Refused
from service.mission.idempotency import Answered, IdempotentAnswers, digest_of
from shared.wire.schemas import BatchRequest, DecideRequest
from tests.support.half_heard import COLUMNS


def _request(step: int = 2, /, **columns: list[Any]) -> DecideRequest:
    body = {"mission_id": "m", "uav_id": 0, "step": step, "position": [1, 2], "sensors": {**COLUMNS, **columns}}
    return DecideRequest.model_validate(body)


def _batch(*requests: DecideRequest) -> BatchRequest:
    uavs = [request.model_dump(include={"position", "sensors"}) | {"uav_id": i} for i, request in enumerate(requests)]
    return BatchRequest.model_validate({"mission_id": "m", "step": 2, "uavs": uavs})


def test_the_digest_is_the_same_for_the_same_request_only() -> None:
    different: list[DecideRequest | BatchRequest] = [
        _request(),
        _request(3),
        *(_request(**{name: [column[0] + 1, column[1]]}) for name, column in COLUMNS.items()),
        _request(id=[8, 3]),
        _request(queue=[0, 0], battery=[0.0, 0.0], channel_gain=[0.0, 0.0], last_seen=[0, 0]),
        _request(x=[], y=[]),
        _batch(_request()),
        _batch(_request(), _request()),
        _batch(_request(), _request(queue=[5, None])),
    ]
    digests = [digest_of(request) for request in different]
    assert len(set(digests)) == len(different)
    assert digest_of(_request(queue=[4, None])) == digests[0]


@pytest.mark.parametrize("request_", [_request(), _request(x=[], y=[]), _batch(_request())])
def test_a_key_of_an_earlier_version_belongs_to_its_request(request_: DecideRequest | BatchRequest) -> None:
    answers = IdempotentAnswers(8)
    stored = hashlib.sha256(request_.model_dump_json().encode()).hexdigest()
    answers.remember(Answered("k", stored, "[]"))

    async def never() -> str:
        raise AssertionError

    assert asyncio.run(answers.once("k", request_, never, lambda _: None)) == "[]"
    with pytest.raises(Refused):
        asyncio.run(answers.once("k", _request(9), never, lambda _: None))
