from __future__ import annotations

import asyncio
import json
import re
import socket
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from service.api.openapi import ANSWERS
from shared.client.edge_client import AsyncEdgeClient, EdgeClient
from shared.client.errors import EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable
from shared.client.retries_and_redirects import edge_url, parse
from shared.wire.schemas import DecideRequest, DecideResponse, FeedbackRequest, MissionSpec
from shared.world.scenario import SCENARIOS
from simulator.flying.edge_session import LossyTransport
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request
from tests.support.edge_stub import EdgeStub, stub_edge
from tests.support.running import Handler, listening
from tests.support.waiting import PATIENCE_S, Clock, Gate, soon, until


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


@pytest.fixture
def request_() -> DecideRequest:
    observations, _ = PipelineWorld(SCENARIOS["paper"]).reset(seed=0)
    return decide_request(1, observations["uav_1"], "m", deadline_ms=500)


class Awaited:
    """An ``AsyncEdgeClient`` with blocking calls, so that the same tests cover both clients."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._runner = asyncio.Runner()
        self._client = AsyncEdgeClient(*args, **kwargs)

    def __enter__(self) -> Awaited:
        return self

    def __exit__(self, *_: object) -> None:
        self._runner.run(self._client.aclose())
        self._runner.close()

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._client, name)
        return lambda *args, **kwargs: self._runner.run(method(*args, **kwargs))


Opened = Callable[..., EdgeClient]


@pytest.fixture
def pauses() -> list[float]:
    """The seconds that a client of either kind would have paused: none of them is waited for."""
    return []


@pytest.fixture(params=[EdgeClient, Awaited])
def client(request: pytest.FixtureRequest, pauses: list[float]) -> Opened:
    async def awaited(seconds: float) -> None:
        pauses.append(seconds)
        await asyncio.sleep(0)

    def opened(url: str, **options: Any) -> EdgeClient:
        sleep = pauses.append if request.param is EdgeClient else awaited
        made: EdgeClient = request.param(url, **{"timeout_s": PATIENCE_S, "sleep": sleep, **options})
        return made

    return opened


def test_an_exchange_is_measured(stub: EdgeStub, request_: DecideRequest, client: Opened) -> None:
    clock = Clock()
    stub.script = ["slow"]

    def take_an_hour() -> None:
        until(lambda: stub.gate.callers)
        clock.ahead_s = 3600.0
        stub.gate.open()

    with client(stub.url, api_key="k3y", clock=clock.perf_counter) as edge, ThreadPoolExecutor(1) as executor:
        executor.submit(take_an_hour)
        exchange = edge.decide(request_)
    assert exchange.response.step == 0 and exchange.response.uav_id == 1
    assert exchange.rtt_ms >= 3_600_000
    assert exchange.attempts == 1
    assert exchange.request_bytes == len(request_.model_dump_json())
    assert exchange.response_bytes > 100
    assert stub.headers[0]["authorization"] == "Bearer k3y"


def test_a_sensor_never_heard_is_sent_as_null(request_: DecideRequest) -> None:
    heard = [s is not None for s in request_.sensors.last_seen]
    assert any(heard) and not all(heard)
    for column in (request_.sensors.queue, request_.sensors.battery, request_.sensors.channel_gain):
        assert [value is not None for value in column] == heard


def test_a_request_goes_to_the_edge_that_has_the_mission_at_once(
    stub: EdgeStub, request_: DecideRequest, client: Opened, pauses: list[float]
) -> None:
    stub.script = ["elsewhere"]
    with stub_edge() as owner, client(stub.url, api_key="k3y", attempts=1) as edge:
        stub.owner = owner.url
        assert edge.decide(request_).attempts == 1
    assert (stub.decides, pauses) == (owner.decides, [])
    assert owner.headers[0]["idempotency-key"] == stub.headers[0]["idempotency-key"]
    assert owner.headers[0]["authorization"] == "Bearer k3y"


def test_a_request_follows_once_and_then_waits_for_the_lease(
    stub: EdgeStub, request_: DecideRequest, client: Opened, pauses: list[float]
) -> None:
    stub.script = ["elsewhere"]
    with stub_edge() as owner, client(stub.url, attempts=2) as edge:
        owner.script = ["elsewhere"]
        stub.owner = owner.owner = owner.url
        assert edge.decide(request_).attempts == 2
    assert (len(stub.decides), len(owner.decides), pauses) == (2, 1, [3.0])


@pytest.mark.parametrize("owner", ["http://127.0.0.1:1", "nowhere", None])
def test_a_request_whose_owner_is_out_of_reach_waits_for_the_lease(
    owner: str | None, stub: EdgeStub, request_: DecideRequest, client: Opened, pauses: list[float]
) -> None:
    stub.script, stub.owner = ["elsewhere"], owner
    with client(stub.url, attempts=2) as edge:
        assert edge.decide(request_).attempts == 2
    assert pauses == [3.0]
    stub.script = ["elsewhere"]
    with client(stub.url, attempts=1) as edge, pytest.raises(EdgeUnreachable, match="tried once"):
        edge.decide(request_)


def test_requests_to_a_busy_edge_are_retried(stub: EdgeStub, request_: DecideRequest, client: Opened) -> None:
    stub.script = ["busy", "busy"]
    with client(stub.url) as edge:
        assert edge.decide(request_).attempts == 3


def test_retry_after_is_honoured(stub: EdgeStub, request_: DecideRequest, client: Opened, pauses: list[float]) -> None:
    stub.script = ["busy_retry_after"]
    with client(stub.url) as edge:
        assert edge.decide(request_).attempts == 2
    assert len(pauses) == 1 and pauses[0] >= 0.2


def test_retries_are_bounded_and_the_error_names_the_cause(
    stub: EdgeStub, request_: DecideRequest, client: Opened
) -> None:
    stub.otherwise = "busy"
    with client(stub.url, attempts=2) as edge, pytest.raises(EdgeUnreachable) as failed:
        edge.decide(request_)
    assert stub.request_count == 2
    assert stub.url in str(failed.value) and "503 overloaded" in str(failed.value)


def test_a_refusal_carries_the_fields_and_is_not_repeated(
    stub: EdgeStub, request_: DecideRequest, client: Opened
) -> None:
    stub.script = ["invalid"]
    with client(stub.url) as edge, pytest.raises(EdgeRefused, match=r"422: .*sensors\.queue\[0\]") as refused:
        edge.decide(request_)
    assert refused.value.status == 422
    assert refused.value.errors[0].field == "sensors.queue[0]"
    assert refused.value.concerns("queue") and not refused.value.concerns("outcome")
    assert stub.request_count == 1


def test_a_server_error_is_a_refusal(stub: EdgeStub, request_: DecideRequest, client: Opened) -> None:
    stub.script = ["crash"]
    with client(stub.url) as edge, pytest.raises(EdgeRefused, match="500"):
        edge.decide(request_)
    assert stub.request_count == 1


def test_an_error_page_that_is_no_problem_document(stub: EdgeStub, request_: DecideRequest, client: Opened) -> None:
    stub.script = ["html"]
    with client(stub.url) as edge, pytest.raises(EdgeProtocolError, match=f"there is no AIC-VDS edge at {stub.url}"):
        edge.decide(request_)


@pytest.mark.parametrize("address", ["localhost:8000", "ftp://edge", "http://", "http://user:secret@edge"])
def test_an_address_that_is_none_is_an_edge_error_too(address: str) -> None:
    with pytest.raises(EdgeError):
        EdgeClient(address)
    with pytest.raises(ValueError):
        AsyncEdgeClient(address)


def test_garbage_is_no_traceback(stub: EdgeStub, request_: DecideRequest, client: Opened) -> None:
    stub.script = ["garbage", "wrong"]
    with client(stub.url) as edge:
        with pytest.raises(EdgeProtocolError, match="no DecideResponse"):
            edge.decide(request_)
        # A sensor that was not reported is an answer where other UAVs have all that were.
        found = edge.decide(request_)
        assert found.response.sensor_id == 1999
        with pytest.raises(EdgeProtocolError, match="sensor 1999 .* there are 10 sensors"):
            found.within(SCENARIOS["paper"])


async def _whole_request(reader: asyncio.StreamReader) -> None:
    """Read the request and its body: a connection that is closed with a part unread is reset."""
    headers = (await reader.readuntil(b"\r\n\r\n")).lower()
    length = re.search(rb"content-length: (\d+)", headers)
    await reader.readexactly(int(length[1]) if length else 0)


async def _end(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)


async def _reset(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)
    writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


async def _silence(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)
    await reader.read()


async def _redirect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)
    writer.write(b"HTTP/1.1 302 Found\r\nLocation: /login\r\nContent-Length: 0\r\n\r\n")
    await writer.drain()


async def _broken_gzip(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)
    writer.write(b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\nContent-Length: 4\r\n\r\nabcd")
    await writer.drain()


@pytest.mark.parametrize(("answer", "failure"), [(_end, "RemoteProtocolError"), (_reset, "ReadError")])
def test_an_edge_that_ends_the_connection_is_unreachable(
    request_: DecideRequest, client: Opened, answer: Handler, failure: str
) -> None:
    again = pytest.raises(EdgeUnreachable, match=f"tried 2 times: {failure}")
    with listening(answer) as url, client(url, attempts=2) as edge, again:
        edge.decide(request_)


def test_a_silent_edge_is_unreachable(request_: DecideRequest, client: Opened) -> None:
    again = pytest.raises(EdgeUnreachable, match="tried 2 times: ReadTimeout")
    with listening(_silence) as url, client(url, timeout_s=0.5, attempts=2) as edge, again:
        edge.decide(request_)


def test_a_server_that_is_no_edge_is_a_protocol_error(request_: DecideRequest, client: Opened) -> None:
    with listening(_redirect) as url, client(url) as edge, pytest.raises(EdgeProtocolError, match="302"):
        edge.decide(request_)
    with listening(_broken_gzip) as url, client(url) as edge, pytest.raises(EdgeProtocolError, match="broken body"):
        edge.decide(request_)


def test_waiting_for_the_llm(stub: EdgeStub, client: Opened) -> None:
    stub.readiness = [(False, "loading"), (True, "loading"), (True, "ready")]
    heard: list[str] = []
    with client(stub.url) as edge:
        assert edge.wait_ready(PATIENCE_S, on_wait=heard.append).llm == "ready"
    assert len(heard) == 2 and heard[1] == "the LLM is loading"


def test_an_edge_whose_llm_still_loads_can_be_flown(stub: EdgeStub, client: Opened) -> None:
    stub.readiness = [(True, "loading")]
    with client(stub.url) as edge:
        assert edge.wait_ready(0).llm == "loading"
        assert edge.wait_ready(PATIENCE_S, wait_out=()).llm == "loading"
    assert stub.polled == 2


def test_an_edge_that_never_comes(client: Opened) -> None:
    with client("http://127.0.0.1:1") as edge, pytest.raises(EdgeUnreachable, match=r"127\.0\.0\.1:1 .*ConnectError"):
        edge.wait_ready(0)


async def test_decisions_are_awaited_concurrently(stub: EdgeStub, request_: DecideRequest) -> None:
    stub.otherwise = "slow"
    async with AsyncEdgeClient(stub.url) as edge:
        asked = [edge.decide(request_.model_copy(update={"uav_id": uav})) for uav in range(4)]
        together = asyncio.gather(*asked)
        # Each is answered when all of them have come.
        await soon(lambda: stub.gate.callers == 4)
        stub.gate.open()
        exchanges = await together
    assert [exchange.response.uav_id for exchange in exchanges] == [0, 1, 2, 3]
    assert stub.most_at_once == 4


async def test_a_cancelled_call_is_not_sent_again(stub: EdgeStub, request_: DecideRequest) -> None:
    pause = Gate()

    async def sleep(seconds: float) -> None:
        await pause.passed()

    stub.otherwise = "busy"
    async with AsyncEdgeClient(stub.url, attempts=100, sleep=sleep) as edge:
        call = asyncio.create_task(edge.decide(request_))
        await soon(lambda: pause.callers)
        call.cancel()
        await asyncio.gather(call, return_exceptions=True)
        pause.open()
        # No task is left that could send it again.
        assert call.cancelled() and asyncio.all_tasks() == {asyncio.current_task()}
        assert stub.request_count == 1


def test_a_mission_and_feedback(stub: EdgeStub, client: Opened) -> None:
    with client(stub.url + "/") as edge:
        status = edge.put_mission("m-1", MissionSpec(scenario=SCENARIOS["stress"], seed=3))
        answer = edge.feedback(FeedbackRequest(decision_id="0" * 32, cost=1.5, failed=True))
        assert edge.mission("m-1") == status
        edge.delete_mission("m-1")
        with pytest.raises(EdgeRefused, match="404"):
            edge.mission("m-1")
    assert status.scenario == SCENARIOS["stress"] and status.seed == 3
    assert answer.result == "applied"


@pytest.mark.parametrize("text", ["", "edge:8000", "ftp://edge", "http://", "http://me:pw@edge", "http://edge?key=1"])
def test_invalid_edge_urls(text: str) -> None:
    with pytest.raises(ValueError):
        edge_url(text)


def test_a_lossy_uplink_loses_the_same_requests_again() -> None:
    def lost(seed: int) -> list[int]:
        inner = httpx.MockTransport(lambda _: httpx.Response(200))
        missing = []
        with httpx.Client(transport=LossyTransport(inner, drop=0.3, jitter_ms=1, seed=seed)) as http:
            for number in range(60):
                try:
                    http.get("http://edge/")
                except httpx.ConnectTimeout:
                    missing.append(number)
        return missing

    assert 5 < len(lost(0)) < 35
    assert lost(0) == lost(0) != lost(1)


def test_a_lossy_uplink_is_retried(stub: EdgeStub, request_: DecideRequest) -> None:
    transport = LossyTransport(httpx.HTTPTransport(), drop=0.5, jitter_ms=5, seed=0)
    pauses: list[float] = []
    with EdgeClient(stub.url, timeout_s=PATIENCE_S, attempts=12, transport=transport, sleep=pauses.append) as edge:
        attempts = [edge.decide(request_).attempts for _ in range(6)]
    assert max(attempts) > 1 and len(pauses) == sum(attempts) - 6
    assert stub.request_count == 6


async def _not_ready(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _whole_request(reader)
    body = json.dumps({"ready": False, "abilities": "x" * 300, "detail": "the store fails: disk full"}).encode()
    writer.write(b"HTTP/1.1 503 No\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))


def test_the_cause_of_an_edge_that_is_not_ready_is_named(client: Opened) -> None:
    with (
        listening(_not_ready) as url,
        client(url) as edge,
        pytest.raises(EdgeUnreachable, match=r"503 the store fails: disk full$"),
    ):
        edge.wait_ready(0.0)


def test_a_deletion_that_is_redirected_is_none(client: Opened) -> None:
    with listening(_redirect) as url, client(url) as edge, pytest.raises(EdgeProtocolError, match="302, a redirect"):
        edge.delete_mission("m")


def test_a_key_of_any_letters_is_sent(stub: EdgeStub, request_: DecideRequest) -> None:
    with EdgeClient(stub.url, api_key="aicvds_\u2026") as edge:
        assert edge.decide(request_).response.step == request_.step


def test_a_later_edges_further_fields_are_ignored() -> None:
    known = ANSWERS["post /decide"]
    later = known | {"later": [1], "tokens": known["tokens"] | {"later": 2}}
    answer, url = httpx.Response(200, json=later), "http://edge/decide"
    answer.request = httpx.Request("POST", url)
    assert parse(DecideResponse, answer) == DecideResponse.model_validate(known)
