"""The process that writes a SQLite store: killed, stopped, signalled, unable to start, and left behind."""

from __future__ import annotations

import asyncio
import ctypes
import os
import platform
import signal
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from service.config.settings import Settings
from service.mission.resolved_spec import ResolvedSpec
from service.storage.locks import StoreUnusable
from service.storage.operations import Change, Checkpoint, Deleted, Made, WriteFailed
from service.storage.store import Store
from shared.wire.schemas import MissionSpec
from tests.support.processes import serving_edge
from tests.support.stored_missions import commit_changes, fly, running, stored_decision, writers
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]


def made(mission_id: str) -> Made:
    spec = MissionSpec()
    return Made(mission_id, spec, ResolvedSpec.of(spec, Settings()))


def _ended(process: psutil.Process) -> bool:
    return bool(psutil.wait_procs([process], timeout=PATIENCE_S)[0])


def test_a_writer_that_is_killed_is_followed_by_another_and_nothing_is_lost(
    tmp_path: Path, report: Report, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        pending = fly(client, report, range(2))
        (first,) = writers(os.getpid())
        # What it was sent it has not written.
        first.suspend()
        with monkeypatch.context() as impatient:
            impatient.setattr("service.edge.engine.STORE_S", 0.1)
            reported = client.post("/decide", json=report(step=2, outcome=pending[0]))
        assert (reported.status_code, reported.json()["stored"]) == (200, False)
        # Nor does an answer wait past its UAV's deadline.
        late = client.post("/decide", json=report(step=2, uav_id=1, deadline_ms=100))
        assert (late.status_code, late.json()["stored"]) == (200, False)
        first.kill()
        # Nobody is told: another process writes what this one was to write.
        assert client.post("/decide", json=report(step=3)).json()["stored"]
        assert not engine.journal.failing
        again = client.post("/feedback", json={"mission_id": "test", **pending[0]})
        assert (again.status_code, again.json()["result"]) == (200, "duplicate")
        assert "has ended (exit code -9)" in caplog.text
        # One that has nothing to do is missed only when there is something.
        (second,) = writers(os.getpid())
        second.kill()
        fly(client, report, range(50, 53), {1: pending[1]})
        before = client.get("/missions/test").json()
    assert writers(os.getpid()) == []
    assert "the store fails" not in caplog.text
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json() == before


def test_the_writer_has_short_time_slices_and_nothing_else_of_its_scheduling_changes(
    tmp_path: Path, report: Report
) -> None:
    """Linux shows a process's slice from 6.12 on, and ignores the request for one before."""
    with running(tmp_path / "m.db") as (client, _):
        stored_decision(client, report())
        (writer,) = writers(os.getpid())
        attributes = ctypes.create_string_buffer(48)
        # The system call `sched_getattr`.
        number = {"x86_64": 315, "aarch64": 275}[platform.machine()]
        assert ctypes.CDLL(None).syscall(number, writer.pid, attributes, 48, 0) == 0
        _, policy, flags, nice, priority, slice_ns, _, _ = struct.unpack("IIQiIQQQ", attributes.raw)
    assert (policy, flags, nice, priority) == (os.SCHED_OTHER, 0, os.getpriority(os.PRIO_PROCESS, 0), 0)
    since = tuple(map(int, platform.release().split(".")[:2]))
    assert slice_ns == (100_000 if since >= (6, 12) else 0)


@pytest.mark.long
def test_the_last_commit_of_a_killed_edge_ends_before_another_edge_begins(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "m.db"
    with serving_edge(AICVDS_STORE=str(path), AICVDS_MODE="value") as (url, process):
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            stored_decision(client, report())
        (writer,) = writers(process.pid)
        writer.suspend()
        assert not httpx.post(f"{url}/decide", json=report(step=1), timeout=PATIENCE_S).json()["stored"]
        process.kill()
        process.wait()
        with pytest.raises(StoreUnusable, match="another edge uses"):
            Store(str(path))
        writer.resume()
        assert _ended(writer)
    with running(path) as (client, _):
        assert client.get("/missions/test").json()["decisions"] == 2


def test_what_a_terminal_sends_to_the_edge_is_not_for_its_writer(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(1))
        (writer,) = writers(os.getpid())
        assert os.getpgid(writer.pid) != os.getpgid(0)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            writer.send_signal(number)
        fly(client, report, range(1, 3))
        assert writers(os.getpid()) == [writer]


@pytest.mark.long
def test_an_edge_ends_though_its_writer_hangs(tmp_path: Path, report: Report) -> None:
    with serving_edge(AICVDS_STORE=str(tmp_path / "m.db"), AICVDS_MODE="value") as (url, process):
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            stored_decision(client, report())
        (writer,) = writers(process.pid)
        writer.suspend()
        assert not httpx.post(f"{url}/decide", json=report(step=1), timeout=PATIENCE_S).json()["stored"]
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        writer.resume()
        assert _ended(writer)


async def test_a_writer_that_cannot_be_started_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(str(tmp_path / "m.db"))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    writer = store.writer()
    with pytest.raises(FileNotFoundError):
        await commit_changes(writer, [Deleted("nobody")])
    monkeypatch.undo()
    await commit_changes(writer, [made("test")])
    assert store.missions() == ["test"]
    writer.close()
    store.close()


async def test_a_writer_that_ends_again_and_again_is_told_with_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(str(tmp_path / "m.db"))
    broken = tmp_path / "broken.py"
    broken.write_text("raise SystemExit('this disk is on fire')")
    monkeypatch.setattr("service.storage.sqlite_writer.__file__", str(broken))
    writer = store.writer()
    for _ in range(3):
        with pytest.raises(WriteFailed, match="this disk is on fire"):
            await commit_changes(writer, [Deleted("nobody")])
    monkeypatch.undo()
    await commit_changes(writer, [made("test")])
    assert store.missions() == ["test"]
    writer.close()
    store.close()


async def test_what_is_larger_than_the_socket_takes_at_once_arrives_whole(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "m.db"))
    writer = store.writer()
    states, kept = [os.urandom(5_000_000), os.urandom(9)], "SELECT seq, state FROM checkpoints"
    changes: list[Change] = [made("test"), Checkpoint("test", 7, states[0])]
    await commit_changes(writer, changes)
    with store._engine.connect() as db:
        assert db.exec_driver_sql(kept).all() == [(7, states[0])]
    await commit_changes(writer, [Checkpoint("test", 8, states[1]), made("other")])
    assert sorted(store.missions()) == ["other", "test"]
    with store._engine.connect() as db:
        assert db.exec_driver_sql(kept).all() == [(8, states[1])]
    writer.close()
    store.close()


async def test_a_transaction_is_written_whole_or_not_at_all_and_the_next_one_is(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "m.db"))
    writer = store.writer()
    with store._engine.begin() as db:
        db.exec_driver_sql("CREATE TRIGGER t BEFORE INSERT ON checkpoints BEGIN SELECT RAISE(ABORT, 'not today'); END")
    with pytest.raises(WriteFailed, match="not today"):
        await commit_changes(writer, [made("test"), Checkpoint("test", 1, b"")])
    assert store.missions() == []
    await commit_changes(writer, [made("test")])
    # Nor does it matter that it was written already.
    await commit_changes(writer, [made("test")])
    assert store.missions() == ["test"]
    await asyncio.sleep(0)
    writer.close()
    store.close()
