"""Two edges on one PostgreSQL behind haproxy: owners killed and paused under load, and the database restarted."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.faults.fleet import Report
from tests.faults.shared_fleet import LEASE_S, MISSIONS, Trial, Uav, flying
from tests.faults.table import Tables
from tests.support.shared_store import Database, SharedEdge, edges, proxy
from tests.support.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.faults, pytest.mark.timeout(900), pytest.mark.needs("haproxy")]

KILLS, PAUSES, RESTARTS = 20, 5, 5
# The longest wait for a mission's next decision, from the end of its lease.
MOST_S = 2.0
TITLE = "Two edges on one PostgreSQL, behind haproxy"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    shared = Database(tmp_path / "postgres")
    yield shared
    shared.close()


@pytest.fixture
def shared(tmp_path: Path, database: Database) -> Iterator[list[SharedEdge]]:
    with edges(database.url, LEASE_S, tmp_path) as started:
        yield started


@pytest.fixture
def trial(tmp_path: Path, shared: list[SharedEdge], report: Report) -> Iterator[Trial]:
    with proxy(shared, tmp_path) as url, flying(url, report) as trial:
        yield trial


def test_owners_are_killed(trial: Trial, shared: list[SharedEdge], tables: Tables) -> None:
    chance = random.Random(5)
    for kill in range(KILLS):
        time.sleep(chance.uniform(0.1, 0.6))
        killed = shared[kill % 2]
        killed.send(signal.SIGKILL)
        trial.goes_on()
        killed.start()
    trial.finish(tables, TITLE, "an owner is killed (kill -9)", KILLS)
    assert max(trial.gaps_s) < LEASE_S + MOST_S


@contextmanager
def _paused(edge: SharedEdge) -> Iterator[None]:
    edge.send(signal.SIGSTOP)
    try:
        yield
    finally:
        edge.send(signal.SIGCONT)


def _owned(trial: Trial, edge: SharedEdge) -> list[Uav]:
    """The UAVs whose missions the edge owns."""
    listed = httpx.get(f"{edge.url}/missions", timeout=PATIENCE_S).json()["missions"]
    names = {line["mission_id"] for line in listed if line["mode"] is not None}
    return [uav for uav in trial.fleet if uav.mission in names]


def test_owners_are_paused_past_their_term(
    trial: Trial, shared: list[SharedEdge], report: Report, tables: Tables
) -> None:
    refused = 0
    for pause in range(PAUSES):
        # The one that was paused before knows by now what it has lost.
        until(lambda: sum(len(_owned(trial, edge)) for edge in shared) == MISSIONS)
        paused = max(shared, key=lambda edge: len(_owned(trial, edge)))
        mission = _owned(trial, paused)[0].mission
        body = report(step=10 * pause, mission_id=mission, uav_id=1)
        with ThreadPoolExecutor(1) as pool, _paused(paused):
            waiting = pool.submit(httpx.post, f"{paused.url}/decide", json=body, timeout=PATIENCE_S)
            trial.goes_on()
            time.sleep(LEASE_S)
            paused.send(signal.SIGCONT)
            late = waiting.result()
        # It sends the request to its successor, or has found out in the midst of it.
        assert late.status_code in (421, 503) and "Retry-After" in late.headers, late.text
        refused += 1
        until(paused.ready)
    trial.finish(tables, TITLE, "an owner is paused past its term (SIGSTOP), and resumed", PAUSES)
    assert refused == PAUSES
    assert max(trial.gaps_s) < LEASE_S + MOST_S


def test_the_database_is_restarted(trial: Trial, database: Database, tables: Tables) -> None:
    for _ in range(RESTARTS):
        time.sleep(0.5)
        database.restart()
        trial.goes_on()
    trial.finish(tables, TITLE, "PostgreSQL is restarted (immediate)", RESTARTS)
    assert max(trial.gaps_s) < LEASE_S + MOST_S
