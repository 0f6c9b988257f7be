"""SIGTERM in the middle of the work: what is in hand is answered, the process ends in time, and nothing is lost."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.faults.fleet import Report
from tests.faults.table import Tables
from tests.support.processes import serving_edge
from tests.support.running import listening
from tests.support.stub_llm import http_answer, misbehaving, wait_for

pytestmark = [pytest.mark.faults, pytest.mark.timeout(300)]

TIMES, UAVS, MOST_S = 6, 6, 10.0


async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await asyncio.sleep(0.3)
    await http_answer(b"200 OK", b'{"choices": [{"message": {"content": "0 7"}}]}')(reader, writer)


class Uav(threading.Thread):
    """Flies a mission of its own until nobody listens any more; ``cut`` counts requests that were taken and dropped."""

    def __init__(self, number: int, url: str, report: Report) -> None:
        super().__init__(daemon=True)
        self._mission, self._url, self._report = f"m{number}", url, report
        self.reported: list[str] = []
        self.acknowledged = self.cut = 0
        self.pending: dict[str, Any] | None = None

    def run(self) -> None:
        for step in range(10_000):
            body = self._report(step=step, mission_id=self._mission, outcome=self.pending)
            try:
                # A connection each: a kept one may be closed just as a request goes out on it.
                answer = httpx.post(f"{self._url}/decide", json=body, timeout=30)
            except httpx.ConnectError:
                return
            except httpx.TransportError:
                self.cut += 1
                return
            assert answer.status_code == 200, answer.text
            assert answer.json()["stored"] is True
            self.acknowledged += self.pending is not None
            self.reported.append(answer.json()["decision_id"])
            self.pending = {"decision_id": self.reported[-1], "cost": 0.2}


def test_sigterm_under_load(tmp_path: Path, report: Report, tables: Tables) -> None:
    took, cut, acknowledged, lost = [], 0, 0, 0
    with listening(misbehaving(slowly)) as llm:
        for turn in range(TIMES):
            settings = {
                "AICVDS_STORE": str(tmp_path / f"{turn}.db"),
                "AICVDS_MODE": "llm",
                "AICVDS_PLANNER": "off",
                "AICVDS_LLM_URL": f"{llm}/v1",
            }
            with serving_edge(**settings) as (url, process):
                with httpx.Client(base_url=url, timeout=10) as client:
                    wait_for(client, "ready")
                fleet = [Uav(number, url, report) for number in range(UAVS)]
                for uav in fleet:
                    uav.start()
                time.sleep(3.0 + 0.07 * turn)
                began = time.perf_counter()
                process.send_signal(signal.SIGTERM)
                process.communicate(timeout=30)
                took.append(time.perf_counter() - began)
                assert process.returncode == 0
                for uav in fleet:
                    uav.join(timeout=30)
            with (
                serving_edge(**{**settings, "AICVDS_MODE": "policy"}) as (url, _),
                httpx.Client(base_url=url) as client,
            ):
                for number, uav in enumerate(fleet):
                    status = client.get(f"/missions/m{number}").json()
                    acknowledged += uav.acknowledged
                    cut += uav.cut
                    lost += uav.acknowledged - status["feedback"]
                    lost += len(uav.reported) - status["decisions"]
    tables.add(
        "SIGTERM under load",
        times=TIMES,
        requests_taken_and_not_answered=cut,
        outcomes_acknowledged=acknowledged,
        decisions_or_outcomes_lost=lost,
        slowest_end_s=f"{max(took):.2f}",
    )
    assert acknowledged > TIMES * UAVS
    assert (cut, lost) == (0, 0)
    assert max(took) < MOST_S
