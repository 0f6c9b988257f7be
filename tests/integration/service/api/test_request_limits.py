"""Too many at once: first the policy decides in the LLM's place, then requests are refused, and probes never."""

from __future__ import annotations

import asyncio
import json
import select
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.api_keys import KeyFile
from tests.support.running import Handler, listening
from tests.support.stub_llm import http_answer, misbehaving, wait_for
from tests.support.waiting import PATIENCE_S, Gate, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def behind(gate: Gate) -> Handler:
    """Says where to fly, to whoever asks, once the gate is open."""

    async def fault(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await gate.passed()
        await http_answer(b"200 OK", b'{"choices": [{"message": {"content": "0 7"}}]}')(reader, writer)

    return fault


def test_more_than_may_wait_for_the_llm_are_the_policys_at_once(edge: Edge, report: Report) -> None:
    gate = Gate()
    with listening(misbehaving(behind(gate))) as llm, ThreadPoolExecutor(2) as pool, gate:
        client = edge(mode="llm", llm_url=f"{llm}/v1", llm_concurrency=2, planner="off")
        wait_for(client, "ready")

        def ask(number: int) -> str | None:
            reason: str | None = client.post("/decide", json=report(mission_id=f"m{number}")).json()["reason"]
            return reason

        waiting = [pool.submit(ask, number) for number in range(2)]
        until(lambda: gate.callers == 2)
        assert [ask(number) for number in range(2, 8)] == ["llm_busy"] * 6
        # They wait for none of those that do.
        assert not any(asked.done() for asked in waiting)
        gate.open()
        assert [asked.result() for asked in waiting] == [None, None]


def test_past_the_most_requests_the_next_is_refused_and_probes_are_not(edge: Edge, report: Report) -> None:
    gate = Gate()
    with listening(misbehaving(behind(gate))) as llm, ThreadPoolExecutor(2) as pool, gate:
        client = edge(mode="llm", llm_url=f"{llm}/v1", max_requests=2, planner="off")
        wait_for(client, "ready")

        def ask(number: int) -> int:
            return client.post("/decide", json=report(mission_id=f"m{number}")).status_code

        inside = [pool.submit(ask, number) for number in range(2)]
        until(lambda: gate.callers == 2)
        refused = client.post("/feedback", json={"decision_id": "0" * 32, "cost": 0.0})
        assert refused.status_code == 503
        assert refused.headers["retry-after"] == "1"
        assert refused.headers["content-type"] == "application/problem+json"
        assert {client.get(path).status_code for path in ("/healthz", "/readyz", "/metrics")} == {200}
        gate.open()
        assert [asked.result() for asked in inside] == [200, 200]
        assert client.get("/missions/m0").status_code == 200


def test_strangers_whose_bodies_never_come_keep_nobody_out(edge: Edge, report: Report, tmp_path: Path) -> None:
    file = KeyFile()
    key = file.add("fleet", frozenset({"decide", "admin"}), per_minute=1000)
    file.write(tmp_path / "keys.json")
    client = edge(keys=tmp_path / "keys.json", max_requests=2)
    with ExitStack() as held:
        for path in ("/", "/healthz", "/readyz", "/static/", "/metrics", "/missions/m/events"):
            assert begun(held, client, f"POST {path}").recv(65536).startswith(b"HTTP/1.1 401 ")
        answer = client.post("/decide", json=report(), headers={"Authorization": f"Bearer {key}"})
        assert answer.status_code == 200


def test_a_body_that_does_not_come_gives_its_place_back(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.request_limits.BODY_S", 0.1)
    client = edge(max_requests=2)
    with ExitStack() as held:
        for waiting in [begun(held, client, "POST /decide") for _ in range(2)]:
            with waiting.makefile("rb") as said:
                head, _, body = said.read().partition(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 408 ")
            assert b"\r\ncontent-type: application/problem+json" in head
            assert json.loads(body)["errors"][0]["field"] == "body"
        monkeypatch.setattr("service.api.request_limits.BODY_S", PATIENCE_S)
        assert client.post("/decide", json=report()).status_code == 200


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics", "/missions/m/events"])
def test_what_may_always_be_read_is_in_the_crowd_where_a_body_is_sent(
    edge: Edge, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.request_limits.BODY_S", PATIENCE_S)
    client = edge(max_requests=1)
    with ExitStack() as held:
        both = [begun(held, client, f"POST {path}") for _ in range(2)]
        answered, _, _ = select.select(both, [], [], PATIENCE_S)
        # The first one makes room for the second one.
        assert answered == both[:1]
        assert answered[0].recv(65536).startswith(b"HTTP/1.1 408 ")
        assert client.get("/healthz").status_code == 200


def test_bodies_that_arrive_slowly_take_nobodys_place(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.request_limits.BODY_S", PATIENCE_S)
    client = edge(max_requests=2)
    with ExitStack() as held:
        slow = [begun(held, client, "POST /decide") for _ in range(5)]
        for first in slow[:3]:
            assert first.recv(65536).startswith(b"HTTP/1.1 408 ")
        assert client.post("/decide", json=report()).status_code == 200
        assert slow[3].recv(65536).startswith(b"HTTP/1.1 408 ")
        # Its place is free again, so the last one may go on.
        assert client.post("/decide", json=report(step=1)).status_code == 200
        slow[4].sendall(b"no report ")
        assert slow[4].recv(65536).startswith(b"HTTP/1.1 415 ")


LIMIT = 1_000_000


@pytest.mark.parametrize(
    ("header", "sent"),
    [
        ("content-length: 100000000", b""),
        # One byte above the limit, in a chunk after which more may come.
        ("transfer-encoding: chunked", b"%x\r\n" % (LIMIT + 1) + b" " * (LIMIT + 1)),
    ],
    ids=["by its length", "by what came of it"],
)
def test_a_body_above_the_limit_is_refused_before_the_rest_of_it_comes(
    edge: Edge, header: str, sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.request_limits.BODY_S", PATIENCE_S)
    client = edge(max_body_bytes=LIMIT)
    with ExitStack() as held:
        waiting = begun(held, client, "POST /decide", f"content-type: application/json\r\n{header}")
        waiting.sendall(sent)
        # To the end: the edge hangs up instead of reading on.
        with waiting.makefile("rb") as said:
            head, _, body = said.read().partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 413 ") and b"\r\nconnection: close" in head.lower()
    assert json.loads(body)["errors"] == [{"field": "body", "problem": f"larger than {LIMIT} bytes"}]
    assert client.get("/healthz").status_code == 200


def begun(held: ExitStack, client: httpx.Client, asked: str, headers: str = "content-length: 10") -> socket.socket:
    """A request of whose body nothing is sent."""
    address = (client.base_url.host, client.base_url.port or 0)
    connection = held.enter_context(socket.create_connection(address, timeout=PATIENCE_S))
    connection.sendall(f"{asked} HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n\r\n".encode())
    return connection
