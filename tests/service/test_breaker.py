"""An LLM that hangs: three UAVs wait for it, the others do not, and it is asked again when it is well."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from service.llm.breaker import Breaker
from tests.running import listening
from tests.service.stub_llm import misbehaving, saying, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

ANSWER = saying(b"200 OK", b'{"choices": [{"message": {"content": "0 7"}}]}')


def test_three_failures_open_it_and_one_more_for_longer_until_an_answer_closes_it() -> None:
    breaker = Breaker()
    assert [breaker.failed() for _ in range(3)] == [False, False, True]
    assert breaker.pause_s == 5
    assert [breaker.failed() for _ in range(5)] == [True] * 5
    assert breaker.pause_s == 60
    breaker.answered()
    assert [breaker.failed() for _ in range(2)] == [False, False]
    breaker.answered()
    assert [breaker.failed() for _ in range(3)] == [False, False, True]
    assert breaker.pause_s == 5


def test_a_server_that_hangs_keeps_three_waiting_and_is_asked_again_when_it_is_well(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.llm.breaker._PAUSE_S", 0.5)
    hangs = True

    async def fault(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if hangs:
            await reader.read()
        else:
            await ANSWER(reader, writer)

    with listening(misbehaving(fault)) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=400)
        wait_for(client, "ready")
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(5)]
        assert reasons == ["llm_timeout"] * 3 + ["llm_unavailable"] * 2
        ready = client.get("/readyz").json()
        assert ready["llm"] == "unavailable" and "llm_timeout" in ready["detail"]
        # The probe finds it well, and the next decision finds that it is not: one waits, not three.
        wait_for(client, "ready")
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(5, 8)]
        assert reasons == ["llm_timeout"] + ["llm_unavailable"] * 2
        hangs = False
        wait_for(client, "ready")
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(8, 10)]
        assert reasons == [None, None]
        assert "aicvds_llm_breaker_opened_total 2.0" in client.get("/metrics").text


def test_who_hardly_waits_does_not_open_it(edge: Edge, report: Report) -> None:
    """A UAV with a tiny deadline must not take the LLM from all the others."""

    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await asyncio.sleep(0.2)
        await ANSWER(reader, writer)

    with listening(misbehaving(slowly)) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=20_000)
        wait_for(client, "ready")
        hasty = [client.post("/decide", json=report(step=step, deadline_ms=50)).json() for step in range(5)]
        assert {answer["reason"] for answer in hasty} == {"llm_timeout"}
        assert client.post("/decide", json=report(step=5)).json()["source"] == "llm"


def test_a_request_that_is_not_understood_does_not_open_it(edge: Edge, report: Report) -> None:
    with listening(misbehaving(saying(b"400 Bad Request", b"{}"))) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        reasons = {client.post("/decide", json=report(step=step)).json()["reason"] for step in range(6)}
        assert reasons == {"llm_status"}
