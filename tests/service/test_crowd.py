"""Too many at once: first the policy decides in the LLM's place, then requests are refused, and probes never."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx

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
        assert max(ms for reason, ms in answers if reason == "llm_busy") < 2000


def test_past_the_most_requests_the_next_is_refused_and_probes_are_not(edge: Edge, report: Report) -> None:
    asked_llm = threading.Semaphore(0)

    async def waiting(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked_llm.release()
        await reader.read()

    with listening(misbehaving(waiting)) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", max_requests=2, deadline_ms=4000, planner="off")
        wait_for(client, "ready")

        def ask(number: int) -> int:
            return client.post("/decide", json=report(mission_id=f"m{number}")).status_code

        with ThreadPoolExecutor(2) as pool:
            inside = [pool.submit(ask, number) for number in range(2)]
            for _ in inside:
                assert asked_llm.acquire(timeout=10)
            refused = client.post("/feedback", json={"decision_id": "0" * 32, "cost": 0.0})
            assert refused.status_code == 503
            assert refused.headers["retry-after"] == "1"
            assert refused.headers["content-type"] == "application/problem+json"
            assert {client.get(path).status_code for path in ("/healthz", "/readyz", "/metrics")} == {200}
            assert [asked.result() for asked in inside] == [200, 200]
        assert client.get("/missions/m0").status_code == 200
