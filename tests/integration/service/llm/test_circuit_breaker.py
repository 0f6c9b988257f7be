"""An LLM that hangs: three UAVs wait for it, the others do not, and it is asked again when it is well."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi.responses import JSONResponse, Response

from service.config.settings import Settings
from service.llm.answers import Busy, Completion, NoDecision
from service.llm.client import LLMClient
from service.llm.embedded import EmbeddedServer
from service.llm.request_bodies import WarmUp
from service.llm.server import LlmServer, ServerStatus
from service.llm.usability import CircuitBreaker
from tests.support.missions import PAPER
from tests.support.running import listening, serving
from tests.support.stub_llm import FIRST, StubLlm, chat_completion, http_answer, misbehaving, silent, wait_for
from tests.support.waiting import Gate, Striding, soon, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

ANSWER = http_answer(b"200 OK", b'{"choices": [{"message": {"content": "0 7"}}]}')


def test_three_failures_open_it_and_one_more_for_longer_until_an_answer_closes_it() -> None:
    breaker = CircuitBreaker()
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
    monkeypatch.setattr("service.llm.usability.PAUSE_S", 0.01)
    # However short a wait is, it is longer than half of a deadline.
    monkeypatch.setattr("service.llm.server.time", Striding(100.0))
    hangs, probes = True, Gate(opened=True)

    async def fault(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if hangs:
            await reader.read()
        else:
            await ANSWER(reader, writer)

    with listening(misbehaving(fault, probes)) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=100)
        wait_for(client, "ready")
        probes.shut()
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(5)]
        assert reasons == ["llm_timeout"] * 3 + ["llm_unavailable"] * 2
        ready = client.get("/readyz").json()
        assert ready["llm"] == "unavailable" and "llm_timeout" in ready["detail"]
        reported = client.get("/metrics").text
        assert "aicvds_llm_breaker_open 1.0" in reported
        assert 'aicvds_llm_servers{status="unavailable"} 1.0' in reported
        # The probe finds it well, and the next decision finds that it is not: one waits, not three.
        probes.open()
        wait_for(client, "ready")
        probes.shut()
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(5, 8)]
        assert reasons == ["llm_timeout"] + ["llm_unavailable"] * 2
        hangs = False
        probes.open()
        wait_for(client, "ready")
        patient = [report(step=step, deadline_ms=60_000) for step in range(8, 10)]
        reasons = [client.post("/decide", json=body).json()["reason"] for body in patient]
        assert reasons == [None, None]
        reported = client.get("/metrics").text
        assert "aicvds_llm_breaker_opened_total 2.0" in reported
        assert "aicvds_llm_breaker_open 0.0" in reported
        assert 'aicvds_llm_servers{status="ready"} 1.0' in reported


def test_who_hardly_waits_does_not_open_it(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    """A UAV with a tiny deadline must not take the LLM from all the others."""
    gate = Gate()
    # Five wait a second each, which is less than half of a minute.
    monkeypatch.setattr("service.llm.server.time", Striding(1.0))

    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await gate.passed()
        await ANSWER(reader, writer)

    with listening(misbehaving(slowly)) as url, gate:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        hasty = [client.post("/decide", json=report(step=step, deadline_ms=50)).json() for step in range(5)]
        assert {answer["reason"] for answer in hasty} == {"llm_timeout"}
        gate.open()
        assert client.post("/decide", json=report(step=5)).json()["source"] == "llm"


def test_a_request_that_is_not_understood_does_not_open_it(edge: Edge, report: Report) -> None:
    with listening(misbehaving(http_answer(b"400 Bad Request", b"{}"))) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        reasons = {client.post("/decide", json=report(step=step)).json()["reason"] for step in range(6)}
        assert reasons == {"llm_status"}


@pytest.mark.usefixtures("left_alone")
def test_a_fleet_that_shares_a_deadline_opens_it_too(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each waits a third of it, which is less than half."""
    monkeypatch.setattr("service.llm.server.time", Striding(0.1))
    with listening(misbehaving(silent)) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=300)
        wait_for(client, "ready")
        for step in range(3):
            states = [report(step=step, uav_id=i) for i in range(3)]
            uavs = [{key: state[key] for key in ("uav_id", "position", "sensors")} for state in states]
            decided = client.post("/decide/batch", json={"mission_id": "test", "step": step, "uavs": uavs})
            assert {d["reason"] for d in decided.json()["decisions"]} <= {"llm_timeout", "llm_unavailable"}
        assert client.get("/readyz").json()["llm"] == "unavailable"


def all_came(queue: Gate, many: int, asked: list[Future[httpx.Response]]) -> bool:
    """Whether so many stand in the queue, or nobody does any more."""
    return queue.callers == many or all(one.done() for one in asked)


def test_who_stood_in_a_queue_does_not_open_it(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    """One slot, and more UAVs than it serves within the deadline: the last of every step are late, the LLM is well."""
    clock = Striding(0.0)
    monkeypatch.setattr("service.llm.server.time", clock)
    slot, queue = Gate(), Gate()

    async def one_by_one(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if slot.callers % 2 == 0:
            await slot.passed()
            await ANSWER(reader, writer)
        else:
            await queue.passed()

    with listening(misbehaving(one_by_one)) as url, ThreadPoolExecutor(10) as pool, slot, queue:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        client.put("/missions/test", json={"scenario": {**PAPER.model_dump(), "uavs": 10}, "planner": "off"})
        wait_for(client, "ready")
        for step in range(3):
            slot.shut()
            served = pool.submit(client.post, "/decide", json=report(step=step))
            until(lambda: slot.callers % 2)
            before = queue.callers
            hasty = [report(step=step, uav_id=i, deadline_ms=500) for i in range(1, 10)]
            late = [pool.submit(client.post, "/decide", json=body) for body in hasty]
            until(partial(all_came, queue, before + 9, late))
            # Longer than a deadline: every UAV in the queue has waited that long.
            clock.now_s += 100.0
            slot.open()
            # The LLM's word was heard, where another has the sensor that it names too.
            assert served.result().json()["reason"] in (None, "answer_reserved")
            reasons = {asked.result().json()["reason"] for asked in late}
            # On a busy machine a UAV may come so late that the others have every sensor.
            assert reasons - {"no_candidate"} == {"llm_timeout"}
            slot.callers += 1
        assert client.get("/readyz").json()["llm"] == "ready"


def test_a_note_sent_while_it_is_open_is_compiled_when_it_is_well(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.llm.usability.PAUSE_S", 0.01)
    probes = Gate(opened=True)

    class Ill(StubLlm):
        async def respond(self, body: dict[str, Any], probed: bool) -> Response:
            if body["messages"][0]["content"].startswith("Rewrite"):
                return chat_completion("visit sensor 3 every 3 steps")
            if probed:
                await probes.passed()
            failing = body["messages"][-1]["content"] != FIRST and not probed
            return JSONResponse({}, status_code=500) if failing else await super().respond(body, probed)

    with serving(Ill().app) as url, probes:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        probes.shut()
        for step in range(3):
            client.post("/decide", json=report(step=step, mission_id="other"))
        assert client.get("/readyz").json()["llm"] == "unavailable"
        client.put("/missions/test", json={"note": "Sensor 3 hums, so somebody should see it every 3 steps."})
        assert client.get("/missions/test/guidance").json()["status"] == "compiling"
        probes.open()
        until(lambda: client.get("/missions/test/guidance").json()["status"] != "compiling")
        reported = client.get("/missions/test/guidance").json()
    assert reported["status"] == "proposed", reported


def test_a_server_that_refuses_the_first_question_may_still_answer_others(edge: Edge, report: Report) -> None:
    """Reading the static block beforehand only saves time."""

    class Picky(StubLlm):
        async def respond(self, body: dict[str, Any], probed: bool) -> Response:
            refused = body["messages"][-1]["content"] == FIRST
            return JSONResponse({}, status_code=400) if refused else await super().respond(body, probed)

    with serving(Picky().app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"


@pytest.mark.parametrize(("lists", "llm"), [(1, "unavailable"), (2, "ready")])
async def test_the_silence_of_calls_for_one_uav_alone_opens_it(
    monkeypatch: pytest.MonkeyPatch, lists: int, llm: str
) -> None:
    """A call for several takes longer, and its end by a deadline says nothing about calls for one."""

    class Hanging(LLMClient):
        async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
            asked.set()
            await asyncio.Event().wait()
            raise AssertionError

    monkeypatch.setattr("service.llm.server.time", Striding(100.0))
    server, asked = LlmServer(Settings(mode="llm"), WarmUp("", "", None)), asyncio.Event()
    server.status, server.connection.client = ServerStatus("ready"), Hanging("http://localhost/v1")
    for _ in range(3):
        asked.clear()
        call = asyncio.create_task(server.ask_labels("test", "", "", [["A", "B"]] * lists))
        await asked.wait()
        call.cancel()
        await asyncio.gather(call, return_exceptions=True)
    assert server.status.llm == llm
    await server.close()


async def test_a_server_that_asks_for_a_pause_while_it_starts_gets_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        await asyncio.Event().wait()

    async def embed(settings: Settings) -> EmbeddedServer:
        raise Busy("HTTP 503", 1060.0)

    for module in ("answers", "server"):
        monkeypatch.setattr(f"service.llm.{module}.time", Striding(0.0))
    monkeypatch.setattr("service.llm.server.asyncio", SimpleNamespace(**{**vars(asyncio), "sleep": pause}))
    server = LlmServer(Settings(mode="llm"), WarmUp("", "", None), embed=embed)
    server.start()
    await soon(lambda: pauses)
    assert pauses == [60.0]
    assert server.readiness().detail == "HTTP 503"
    await server.close()


@pytest.mark.parametrize(
    ("stride_s", "asked", "expected"),
    [(0.1, None, [5.0, 5.0, 5.0]), (100.0, None, [5.0, 10.0, 20.0]), (0.0, 30.0, [5.0, 30.0, 30.0])],
)
async def test_a_server_that_refuses_at_once_is_probed_every_five_seconds(
    monkeypatch: pytest.MonkeyPatch, stride_s: float, asked: float | None, expected: list[float]
) -> None:
    """A gateway answers 503 while the server behind it starts, or asks for a pause. A slow failure costs time."""
    pauses: list[float] = []
    asks = False

    class Gateway(LLMClient):
        async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
            if asks and asked:
                raise Busy("HTTP 429: no deployments", 1000.0 + asked)
            raise NoDecision("llm_status", "HTTP 503: no available workers")

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == len(expected):
            await asyncio.Event().wait()

    monkeypatch.setattr("service.llm.answers.time", Striding(0.0))
    monkeypatch.setattr("service.llm.server.time", Striding(stride_s))
    monkeypatch.setattr("service.llm.server.asyncio", SimpleNamespace(**{**vars(asyncio), "sleep": pause}))
    server = LlmServer(Settings(mode="llm"), WarmUp("", "", None))
    server.status, server.connection.client = ServerStatus("ready"), Gateway("http://localhost/v1")
    for _ in range(3):
        with pytest.raises(NoDecision):
            await server.ask_labels("test", "", "", [["A", "B"]])
    asks = True
    await soon(lambda: len(pauses) == len(expected))
    assert pauses == expected
    await server.close()
