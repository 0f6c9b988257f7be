"""Too many at once: first the policy decides in the LLM's place, then requests are refused, and probes never."""

from __future__ import annotations

import asyncio
import json
import select
import socket
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.keys import KeyFile
from tests.running import listening
from tests.service.stub_llm import misbehaving, silent, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def test_more_than_may_wait_for_the_llm_are_the_policys_at_once(edge: Edge, report: Report) -> None:
    with listening(misbehaving(silent)) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", llm_concurrency=2, deadline_ms=3000, planner="off")
        wait_for(client, "ready")

        def ask(number: int) -> tuple[str, float]:
            answer = client.post("/decide", json=report(mission_id=f"m{number}")).json()
            return answer["reason"], answer["latency_ms"]["total"]

        with ThreadPoolExecutor(8) as pool:
            answers = list(pool.map(ask, range(8)))
        assert Counter(reason for reason, _ in answers) == {"llm_busy": 6, "llm_timeout": 2}
        # They wait for none of those that do.
        spent = {reason: [ms for why, ms in answers if why == reason] for reason, _ in answers}
        assert max(spent["llm_busy"]) < min(spent["llm_timeout"])


def test_past_the_most_requests_the_next_is_refused_and_probes_are_not(edge: Edge, report: Report) -> None:
    queried_llm = threading.Semaphore(0)

    async def waiting(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        queried_llm.release()
        await reader.read()

    with listening(misbehaving(waiting)) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", max_requests=2, deadline_ms=4000, planner="off")
        wait_for(client, "ready")

        def ask(number: int) -> int:
            return client.post("/decide", json=report(mission_id=f"m{number}")).status_code

        with ThreadPoolExecutor(2) as pool:
            inside = [pool.submit(ask, number) for number in range(2)]
            for _ in inside:
                assert queried_llm.acquire(timeout=10)
            refused = client.post("/feedback", json={"decision_id": "0" * 32, "cost": 0.0})
            assert refused.status_code == 503
            assert refused.headers["retry-after"] == "1"
            assert refused.headers["content-type"] == "application/problem+json"
            assert {client.get(path).status_code for path in ("/healthz", "/readyz", "/metrics")} == {200}
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
    monkeypatch.setattr("service.limits._BODY_S", 0.5)
    client = edge(max_requests=2)
    with ExitStack() as held:
        for waiting in [begun(held, client, "POST /decide") for _ in range(2)]:
            with waiting.makefile("rb") as said:
                head, _, body = said.read().partition(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 408 ")
            assert b"\r\ncontent-type: application/problem+json" in head
            assert json.loads(body)["errors"][0]["field"] == "body"
        assert client.post("/decide", json=report()).status_code == 200


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics", "/missions/m/events"])
def test_what_may_always_be_read_is_in_the_crowd_where_a_body_is_sent(edge: Edge, path: str) -> None:
    client = edge(max_requests=1)
    with ExitStack() as held:
        both = [begun(held, client, f"POST {path}") for _ in range(2)]
        answered, _, _ = select.select(both, [], [], 30)
        assert [answer.recv(65536)[:13] for answer in answered] == [b"HTTP/1.1 503 "]
        assert client.get("/healthz").status_code == 200


def begun(held: ExitStack, client: httpx.Client, asked: str) -> socket.socket:
    """A request of whose body nothing is sent."""
    address = (client.base_url.host, client.base_url.port or 0)
    connection = held.enter_context(socket.create_connection(address, timeout=30))
    connection.sendall(f"{asked} HTTP/1.1\r\nhost: x\r\ncontent-length: 10\r\n\r\n".encode())
    return connection
