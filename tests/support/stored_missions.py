"""Edges with a store, missions flown on them, and their files on disk."""

from __future__ import annotations

import asyncio
import shutil
import sqlite3
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from service.api.app import create_app
from service.config.settings import Settings
from service.edge.engine import Engine
from service.mission.mission import Mission
from service.storage.journal import Journal
from service.storage.operations import Change, Writer
from service.storage.store import Store
from tests.support.running import serving
from tests.support.storing import empty_store
from tests.support.waiting import PATIENCE_S, until

Body = dict[str, Any]
Report = Callable[..., Body]


@contextmanager
def running(path: Path | str, **settings: Any) -> Iterator[tuple[httpx.Client, Engine]]:
    if "://" not in str(path):
        empty_store(Path(path))
    app = create_app(Settings(**{"mode": "value", "deadline_ms": 60_000, **settings}), Store(str(path)))
    with serving(app) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        yield client, app.state.engine


def state(mission: Mission) -> Body:
    return {**mission.state_dict(), "learner": mission.learner.state_dict()}


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    return bool(one == other)


def fly(client: httpx.Client, report: Report, steps: range, outcomes: dict[int, Body] | None = None) -> dict[int, Body]:
    """Fly three UAVs, and report each outcome with the UAV's next request; returns the unreported outcomes.

    Every fourth transmission fails.
    """
    outcomes = {} if outcomes is None else outcomes
    for step in steps:
        for uav in range(3):
            body = report(step=step, uav_id=uav)
            body["sensors"]["queue"][uav] = 10 + step % 40
            if uav in outcomes:
                body["outcome"] = outcomes[uav]
            answer = client.post("/decide", json=body)
            assert answer.status_code == 200, answer.text
            assert answer.json()["stored"] is True
            failed = (step + uav) % 4 == 0
            outcomes[uav] = {"decision_id": answer.json()["decision_id"], "cost": 0.1 * uav + failed, "failed": failed}
    return outcomes


def copy_of(path: Path, to: Path) -> Path:
    """A copy of the store's files on disk, as after a power failure."""
    for suffix in ("", "-wal"):
        if Path(f"{path}{suffix}").exists():
            shutil.copy(f"{path}{suffix}", f"{to}{suffix}")
    return to


def wait_for_updates(engine: Engine, mission: Mission, updates: int) -> Mission:
    until(lambda: mission.learner.updates >= updates, lambda: mission.learner.updates)
    assert mission.learner.updates == updates
    return mission


def wait_until_written(engine: Engine) -> None:
    """Wait until all earlier changes are on disk."""
    journal = engine.journal
    assert isinstance(journal, Journal)
    until(lambda: journal._commits._written >= journal._commits._added)


def stored_decision(client: httpx.Client, body: Body) -> Body:
    """The decision for a report; the same request is repeated until the decision is on disk."""
    key = {"Idempotency-Key": uuid.uuid4().hex}
    answers: list[Body] = []

    def stored() -> bool:
        answer = client.post("/decide", json=body, headers=key)
        assert answer.status_code == 200, answer.text
        answers.append(answer.json())
        return bool(answers[-1]["stored"])

    until(stored)
    return answers[-1]


def writers(pid: int) -> list[psutil.Process]:
    """The processes that write stores for this one."""
    children = psutil.Process(pid).children()
    return [child for child in children if any("sqlite_writer" in argument for argument in child.cmdline())]


async def commit_changes(writer: Writer, changes: Sequence[Change]) -> None:
    """Write the changes and wait for the end; raises the writer's error."""
    ended = asyncio.get_running_loop().create_future()
    writer.write(changes, ended.set_result)
    async with asyncio.timeout(PATIENCE_S):
        if (error := await ended) is not None:
            raise error


def locked(path: Path) -> sqlite3.Connection:
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    return other
