"""Closing time, for those who wait for the LLM."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from service.storage.journal import Journal
from tests.support.running import listening
from tests.support.stored_missions import running
from tests.support.stub_llm import misbehaving, silent, wait_for
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]


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
