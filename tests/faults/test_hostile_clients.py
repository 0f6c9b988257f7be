"""Hundreds of clients that do not read, read or write a byte a second, or vanish, beside a fleet that flies."""

from __future__ import annotations

import time
from pathlib import Path

import httpx
import psutil
import pytest

from benchmarks.hostile_clients import KINDS, hostile
from tests.faults.fleet import Report, ask, resident_mb
from tests.faults.table import Tables
from tests.support.processes import serving_edge
from tests.support.waiting import until

pytestmark = [pytest.mark.faults, pytest.mark.timeout(300)]

# More than the edge serves at a time, of each kind.
OF_A_KIND, REQUESTS = 100, 64
DEADLINE_MS, SLACK_MS, SECONDS = 1000, 50, 45.0


def test_clients_that_do_not_read_write_slowly_or_vanish(tmp_path: Path, report: Report, tables: Tables) -> None:
    settings = {"AICVDS_MODE": "value", "AICVDS_MAX_REQUESTS": str(REQUESTS), "AICVDS_STORE": str(tmp_path / "m.db")}
    with serving_edge(**settings) as (url, process):
        ask(url, report, 300, DEADLINE_MS)
        step = 100
        edge = psutil.Process(process.pid)
        files, memory = edge.num_fds(), resident_mb(process.pid)
        alone = ask(url, report, 600, DEADLINE_MS, first_step=step)
        with hostile(url, OF_A_KIND) as ended:
            ends = time.monotonic() + SECONDS
            late = []
            while time.monotonic() < ends:
                step += 200
                late.append(ask(url, report, 600, DEADLINE_MS, first_step=step))
            connections = edge.num_fds() - files
            memory = resident_mb(process.pid) - memory
        # All that they had is free again.
        until(lambda: edge.num_fds() <= files, lambda: edge.num_fds())
        missed = httpx.get(f"{url}/metrics").text
        process.terminate()
        lines = [line for line in process.communicate(timeout=30)[0].splitlines() if "decision_id" not in line]
    decisions = sum(len(asked.late_ms) for asked in late)
    worst = max(asked.worst_ms for asked in late)
    tables.add(
        "500 hostile clients beside a fleet",
        clients=f"{OF_A_KIND} of each kind",
        connections_at_the_end=connections,
        ended=", ".join(f"{kind.replace('_', ' ')} {ended[kind]}" for kind in KINDS),
        decisions=decisions,
        refused=0,
        latest_ms_past_the_deadline=f"{worst:.0f}",
        latest_ms_without_them=f"{alone.worst_ms:.0f}",
        memory_MB=f"{memory:+.1f}",
        lines_in_the_log=len(lines),
    )
    assert all(ended[kind] >= OF_A_KIND for kind in KINDS)
    assert all(asked.within(SLACK_MS) == 1.0 for asked in late)
    assert "aicvds_deadline_missed_total 0.0" in missed
    # One line a cause and minute.
    assert len(lines) < 30, lines
    assert not any("Traceback" in line for line in lines)
