"""The time of those who wait for the LLM: it ends with their deadline, and soon when the service closes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import httpx
import pytest

from service.deciding.decision_task import RESERVE_S, DecisionTask
from service.deciding.llm_query import LlmQueries
from service.deciding.pipeline import Pipeline, RecordedDecision
from service.storage.journal import Journal
from tests.support.asking import PATHS, decide
from tests.support.running import listening
from tests.support.stored_missions import running
from tests.support.stub_llm import misbehaving, silent, wait_for
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("mode", "prompt", "query"), [("llm", "csv", "ask_for_pair"), ("llm", "compact", "ask"), ("guided", "csv", "ask")]
)
def test_no_uav_is_let_wait_past_its_deadline(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, mode: str, prompt: str, query: str, path: str
) -> None:
    """For the plan, the LLM and the evaluator: what is left of its time when it begins to wait for each."""
    left_s = list[float]()
    asks, decides = getattr(LlmQueries, query), Pipeline.decide_one

    async def asked(self: LlmQueries, *about: Any) -> Any:
        left_s.append(about[-1].at - perf_counter())
        return await asks(self, *about)

    async def decided(self: Pipeline, task: DecisionTask) -> RecordedDecision:
        left_s.extend(limit.at - perf_counter() for limit in (task.deadline, task.evaluation_deadline))
        return await decides(self, task)

    monkeypatch.setattr(LlmQueries, query, asked)
    monkeypatch.setattr(Pipeline, "decide_one", decided)
    client = edge(mode=mode, llm_url="http://127.0.0.1:9/v1", llm_adapter="served", planner="off", deadline_ms=500)
    assert client.put("/missions/test", json={"prompt": {"format": prompt}}).status_code == 200
    for step, its_own, deadline_s in ((0, {}, 0.5), (1, {"deadline_ms": 250}, 0.25)):
        left_s.clear()
        decide(client, path, *(report(step=step, uav_id=uav, **its_own) for uav in range(2)))
        assert len(left_s) == 2 * 3
        assert max(left_s) <= deadline_s - RESERVE_S


def test_closing_time_at_the_moment_of_a_deadline_fails_nobody(tmp_path: Path, report: Report) -> None:
    with (
        listening(misbehaving(silent)) as llm,
        running(tmp_path / "m.db", mode="llm", llm_url=f"{llm}/v1", planner="off") as (client, engine),
        ThreadPoolExecutor(1) as pool,
    ):
        wait_for(client, "ready")
        late = pool.submit(client.post, "/decide", json=report(deadline_ms=100))

        async def every_turn_of_the_loop() -> None:
            while not late.done():
                engine.queries.hurry()
                await asyncio.sleep(0)

        assert isinstance(engine.journal, Journal)
        asyncio.run_coroutine_threadsafe(every_turn_of_the_loop(), engine.journal._loop).result(PATIENCE_S)
        assert (late.result().status_code, late.result().json()["reason"]) == (200, "llm_timeout")
