"""Deleted missions: gone from the disk when that is said, from memory, and from what still happens to them."""

from __future__ import annotations

import asyncio
import gc
import os
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.edge.mission_registry import MissionRegistry
from service.mission.mission import Mission
from service.storage.store import Store, StoredMission
from tests.support.running import listening
from tests.support.stored_missions import copy_of, fly, running, writers
from tests.support.stub_llm import http_answer, misbehaving, wait_for
from tests.support.waiting import Gate, until

Report = Callable[..., dict[str, Any]]


def test_what_still_happens_to_a_deleted_mission_is_not_the_next_ones(tmp_path: Path, report: Report) -> None:
    gate = Gate()

    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await gate.passed()
        await http_answer(b"200 OK", b'{"choices": [{"message": {"content": "0 7"}}]}')(reader, writer)

    with (
        listening(misbehaving(slowly)) as llm,
        running(tmp_path / "m.db", mode="llm", llm_url=f"{llm}/v1", planner="off") as (client, _),
        ThreadPoolExecutor(1) as pool,
        gate,
    ):
        wait_for(client, "ready")
        late = pool.submit(client.post, "/decide", json=report())
        until(lambda: gate.callers)
        assert client.delete("/missions/test").status_code == 204
        assert client.put("/missions/test", json={"mode": "policy"}).status_code == 200
        reported = client.post("/decide", json=report()).json()
        gate.open()
        assert late.result().status_code == 200
        fed = client.post("/feedback", json={"mission_id": "test", "decision_id": reported["decision_id"], "cost": 0.5})
        assert (fed.status_code, reported["stored"]) == (200, True)
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
    with running(copied) as (client, _):
        status = client.get("/missions/test").json()
        assert (status["mode"], status["decisions"], status["feedback"]) == ("policy", 1, 1)


def test_a_mission_deleted_twice_is_gone_when_that_is_said(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(2))
        # As a disk that takes longer than an answer may.
        (writer,) = writers(os.getpid())
        writer.suspend()
        with monkeypatch.context() as impatient:
            impatient.setattr("service.edge.engine.STORE_S", 0.1)
            assert [client.delete("/missions/test").status_code for _ in range(2)] == [503, 503]
        writer.resume()
        assert client.delete("/missions/test").status_code == 404
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
    left = Store(str(copied))
    assert left.missions() == []
    left.close()


@pytest.mark.parametrize("mode", ["value", "policy", "guided"])
def test_a_deleted_mission_is_gone_from_memory_before_any_collection(tmp_path: Path, report: Report, mode: str) -> None:
    with running(tmp_path / "m.db", mode=mode) as (client, engine):
        fly(client, report, range(3))
        deleted = weakref.ref(engine.missions.loaded[0])
        gc.disable()
        try:
            assert client.delete("/missions/test").status_code == 204
            until(lambda: deleted() is None)
        finally:
            gc.enable()


def test_a_mission_deleted_while_it_wakes_stays_deleted(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(2))
    load, gate = Store.load, Gate()
    delete, find, came = MissionRegistry.delete, MissionRegistry.find, list[str]()

    def slowly(self: Store, mission_id: str) -> StoredMission | None:
        gate.wait()
        return load(self, mission_id)

    async def deleting(self: MissionRegistry, mission_id: str) -> None:
        came.append("delete")
        await delete(self, mission_id)

    async def finding(self: MissionRegistry, mission_id: str, within_s: float) -> Mission | None:
        came.append("find")
        return await find(self, mission_id, within_s)

    monkeypatch.setattr(Store, "load", slowly)
    monkeypatch.setattr(MissionRegistry, "delete", deleting)
    monkeypatch.setattr(MissionRegistry, "find", finding)
    with running(tmp_path / "m.db") as (client, _), ThreadPoolExecutor(3) as pool, gate:
        got = pool.submit(client.get, "/missions/test")
        until(lambda: gate.callers)
        deleted = pool.submit(client.delete, "/missions/test")
        until(lambda: came == ["find", "delete"])
        decided = pool.submit(client.post, "/decide", json=report())
        until(lambda: came == ["find", "delete", "find"])
        gate.open()
        assert (got.result().status_code, deleted.result().status_code, decided.result().status_code) == (200, 204, 200)
        assert client.get("/missions/test").json()["decisions"] == 1


@contextmanager
def deletion_under_way(
    postgres: str, report: Report
) -> Iterator[tuple[httpx.Client, ThreadPoolExecutor, Gate, Callable[[], bool], Future[httpx.Response]]]:
    """A client, a pool, the gate that the deletion's commit waits for, whether it waits still, and its answer."""
    with Gate() as gate, running(postgres) as (client, engine), ThreadPoolExecutor(2) as pool:
        fly(client, report, range(2))
        commits: Any = engine.journal._commits  # type: ignore[union-attr]
        commits._writer._jobs.put(gate.wait)
        until(lambda: gate.callers)
        deleted = pool.submit(client.delete, "/missions/test")
        until(lambda: commits._queue)
        yield client, pool, gate, lambda: bool(commits._queue), deleted


def test_a_mission_whose_deletion_is_under_way_does_not_come_back(postgres: str, report: Report) -> None:
    with deletion_under_way(postgres, report) as (client, pool, gate, _, deleted):
        asked = pool.submit(client.get, "/missions/test")
        with pytest.raises(TimeoutError):
            asked.result(0.2)
        gate.open()
        assert (deleted.result().status_code, asked.result().status_code) == (204, 404)
        assert client.get("/missions/test").status_code == 404


def test_nor_does_it_while_the_deletion_takes_longer_than_a_request_waits(postgres: str, report: Report) -> None:
    with deletion_under_way(postgres, report) as (client, _, gate, waits, deleted):
        asked = client.get("/missions/test")
        assert asked.status_code == 503 and "is being deleted" in asked.json()["detail"]
        gate.open()
        until(lambda: not waits())
        assert deleted.result().status_code in (204, 503)
        assert client.get("/missions/test").status_code == 404
