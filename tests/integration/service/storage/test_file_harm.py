"""What happens to a SQLite store's files under an edge: a change that they may lose is not acknowledged."""

from __future__ import annotations

import os
import resource
import shutil
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from service.config.settings import Settings
from service.mission.events import GuidanceChanged
from service.mission.resolved_spec import ResolvedSpec
from service.storage.locks import StoreUnusable
from service.storage.operations import Change, Checkpoint, Entry, Made
from service.storage.rows import pack
from service.storage.sqlite_writer import Database, identity
from service.storage.store import Store
from shared.wire.schemas import MissionSpec
from tests.support.stored_missions import commit_changes, fly, running, writers
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
PAGE = 4096


def _replaced(path: Path) -> None:
    shutil.copy(path, path.with_name("copy"))
    path.with_name("copy").replace(path)


def _copied_over(path: Path) -> None:
    """As ``cp backup m.db`` does: the file stays, and its bytes are others."""
    shutil.copyfile(path, path.with_name("copy"))
    shutil.copyfile(path.with_name("copy"), path)


def _overwritten(path: Path, at: int = PAGE) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(b"no page" * 100)


def _moved_and_linked(path: Path) -> None:
    """As who runs out of space does: the next edge opens what the link points to, with another log and lock."""
    path.rename(path.with_name("elsewhere.db"))
    path.symlink_to("elsewhere.db")


def _written_by_another_program(path: Path) -> None:
    with sqlite3.connect(path) as other:
        other.execute("DELETE FROM missions")
    other.close()


def _opened_by_another_edge(path: Path) -> None:
    path.with_name("m.db.lock").unlink()
    Store(str(path)).close()


CHANGED = "another program has changed the store's file: restart the edge"
DISPLACED = "was deleted, replaced or hard-linked while the edge ran: undo that, or restart the edge"


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda path: path.unlink(), f"m.db {DISPLACED}"),
        (_replaced, f"m.db {DISPLACED}"),
        (lambda path: path.parent.rename(path.parent.with_name("elsewhere")), f"m.db {DISPLACED}"),
        (_moved_and_linked, f"m.db {DISPLACED}"),
        (lambda path: os.link(path, path.with_name("link.db")), f"m.db {DISPLACED}"),
        # Then another edge can have the lock too.
        (lambda path: path.with_name("m.db.lock").unlink(), f"m.db.lock {DISPLACED}"),
        (_opened_by_another_edge, CHANGED),
        (_copied_over, CHANGED),
        (_overwritten, CHANGED),
        (lambda path: os.truncate(path, PAGE), CHANGED),
        (lambda path: os.truncate(path.with_name("m.db-wal"), 0), CHANGED),
        (lambda path: _overwritten(path.with_name("m.db-wal"), 100), CHANGED),
        (_written_by_another_program, CHANGED),
    ],
    ids=[
        "deleted",
        "replaced",
        "folder renamed",
        "moved, and a link in its place",
        "hard-linked",
        "lock deleted",
        "opened by another edge",
        "copied over",
        "overwritten",
        "truncated",
        "log truncated",
        "log overwritten",
        "written by another program",
    ],
)
def test_a_commit_that_the_next_edge_may_not_find_is_not_stored(
    tmp_path: Path, report: Report, caplog: pytest.LogCaptureFixture, harm: Callable[[Path], object], reason: str
) -> None:
    folder = tmp_path / "stores"
    folder.mkdir()
    path = folder / "m.db"
    with running(path) as (client, _):
        assert client.post("/decide", json=report()).json()["stored"]
        assert client.get("/readyz").status_code == 200
        # The writer looks at the log once it has nothing to write.
        time.sleep(0.1)
        harm(path)
        assert not client.post("/decide", json=report(step=1)).json()["stored"]
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["detail"]) == (503, reason)
        assert client.put("/missions/new", json={}).status_code == 503
        # Nor does another process that writes take another file for this one.
        writers(os.getpid())[0].kill()
        assert not client.post("/decide", json=report(step=2)).json()["stored"]
    assert caplog.text.count(reason) == 1


def test_orders_can_be_withdrawn_while_the_store_fails(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "m.db"
    slow = {"guidance": {"max_velocity": 3}}
    with running(path) as (client, _):
        client.post("/decide", json=report())
        assert client.post("/missions/test/guidance", json=slow).status_code == 200
        path.unlink()
        assert not client.post("/decide", json=report(step=1)).json()["stored"]
        assert client.post("/missions/test/guidance", json=slow).status_code == 503
        # It is obeyed at once; the answer says that it is not on the disk.
        assert client.post("/missions/test/guidance", json={"answer": "withdraw"}).status_code == 503
        assert client.get("/missions/test/guidance").json()["obeyed_in_words"] is None


def test_a_file_that_is_put_back_is_the_store_again(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "m.db"
    with running(path) as (client, _):
        assert client.post("/decide", json=report()).json()["stored"]
        path.rename(tmp_path / "moved")
        assert not client.post("/decide", json=report(step=1)).json()["stored"]
        (tmp_path / "moved").rename(path)
        until(lambda: client.get("/readyz").status_code == 200)
        assert client.post("/decide", json=report(step=2)).json()["stored"]
    with running(path) as (client, _):
        assert client.get("/missions/test").json()["decisions"] == 3


def test_a_log_that_is_deleted_loses_nothing(tmp_path: Path, report: Report, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "m.db"
    with running(path) as (client, _):
        assert client.post("/decide", json=report()).json()["stored"]
        path.with_name("m.db-wal").unlink()
        client.post("/decide", json=report(step=1))
        until(lambda: client.get("/readyz").status_code == 200)
        assert client.post("/decide", json=report(step=2)).json()["stored"]
    assert "m.db-wal was deleted, replaced or hard-linked while the edge ran" in caplog.text
    with running(path) as (client, _):
        assert client.get("/missions/test").json()["decisions"] == 3


@pytest.mark.parametrize(
    ("harm", "reason", "commits"),
    [
        (lambda path: path.unlink(), f"m.db {DISPLACED}", 1),
        (_written_by_another_program, CHANGED, 1),
        # It is looked at twenty times a second.
        (lambda path: path.with_name("m.db-wal").unlink(), f"m.db-wal {DISPLACED}", 1_000_000),
    ],
    ids=["deleted", "written by another program", "log deleted"],
)
def test_a_busy_store_knows_its_file_too(
    tmp_path: Path, harm: Callable[[Path], object], reason: str, commits: int
) -> None:
    path = tmp_path / "m.db"
    store = Store(str(path))
    with sqlite3.connect(path) as db:
        (epoch,) = db.execute("PRAGMA user_version").fetchone()
    db.close()
    database = Database(str(path), epoch, {str(path): identity(str(path))})
    sql = "INSERT INTO missions VALUES (?, '', '')"
    assert [database.commit([(sql, [[name]])]) for name in "abc"] == [None] * 3
    harm(path)
    ends = time.monotonic() + 5.0
    found = next(
        fault
        for n in range(commits)
        if (fault := database.commit([(sql, [[f"more{n}"]])])) is not None or time.monotonic() > ends
    )
    assert found is not None
    assert found[0] == reason
    database.close()
    store.close()


def test_a_commit_that_the_disk_refuses_is_written_later(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "m.db"
    with running(path) as (client, _):
        pending = fly(client, report, range(1))
        (writer,) = writers(os.getpid())
        # As on a full disk, or on a file system that has become read-only.
        unlimited = psutil.Process(writer.pid).rlimit(resource.RLIMIT_FSIZE)
        writer.rlimit(resource.RLIMIT_FSIZE, (PAGE, unlimited[1]))
        assert not client.post("/decide", json=report(step=1)).json()["stored"]
        # Decisions go on, so the edge stays ready.
        assert client.get("/readyz").status_code == 200
        assert client.post("/feedback", json={"mission_id": "test", **pending[0]}).status_code == 503
        writer.rlimit(resource.RLIMIT_FSIZE, unlimited)
        until(lambda: client.post("/feedback", json={"mission_id": "test", **pending[0]}).status_code == 200)
        assert client.post("/decide", json=report(step=2)).json()["stored"]
    with running(path) as (client, _):
        assert client.get("/missions/test").json()["decisions"] == 5


async def test_an_edge_that_another_one_followed_writes_no_more(tmp_path: Path) -> None:
    path = tmp_path / "m.db"
    first = Store(str(path))
    # Its files are the same, but not its epoch.
    lock = first._lock
    first._lock = None
    assert lock is not None
    lock.close()
    second = Store(str(path))
    first._lock = lock
    writer = first.writer()
    with pytest.raises(Exception, match="another edge has opened the store's file"):
        await commit_changes(writer, [made("test")])
    assert second.missions() == []
    writer.close()
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda path: _overwritten(path, 3 * PAGE), "damaged"),
        (lambda path: os.truncate(path, 2 * PAGE), "malformed"),
        (lambda path: os.link(path, path.with_name("link.db")), "hard link"),
    ],
    ids=["overwritten", "truncated", "hard-linked"],
)
def test_a_damaged_file_is_not_opened(tmp_path: Path, harm: Callable[[Path], object], said: str) -> None:
    path = tmp_path / "m.db"
    Store(str(path)).close()
    harm(path)
    with pytest.raises(StoreUnusable, match=said):
        Store(str(path))


def test_a_checkpoint_with_another_byte_is_refused(
    tmp_path: Path, report: Report, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "m.db"
    with running(path) as (client, _):
        fly(client, report, range(1))
        assert client.put("/missions/other", json={}).status_code == 200
    with sqlite3.connect(path) as db:
        (state,) = db.execute("SELECT state FROM checkpoints WHERE mission_id = 'test'").fetchone()
        # In the midst of numbers, where another one is as good.
        at = len(state) // 2
        state = state[:at] + bytes([state[at] ^ 1]) + state[at + 1 :]
        db.execute("UPDATE checkpoints SET state = ? WHERE mission_id = 'test'", [state])
    db.close()
    with running(path) as (client, _):
        assert client.get("/missions/test").status_code == 409
        assert "mission test is damaged: damaged bytes: their checksum differs" in caplog.text
        assert client.get("/missions/other").status_code == 200


def made(mission_id: str, epoch: int = 0, **spec: Any) -> Made:
    asked_for = MissionSpec(**spec)
    return Made(mission_id, asked_for, ResolvedSpec.of(asked_for, Settings()), epoch)


@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
async def test_the_owner_overwrites_an_earlier_mission_of_the_same_id(
    tmp_path: Path, request: pytest.FixtureRequest, database: str
) -> None:
    url = str(tmp_path / "m.db") if database == "sqlite" else request.getfixturevalue("postgres")
    store = Store(url)
    epoch = 0
    if store.leases is not None:
        taken = store.leases.acquire("test", "http://edge", 60.0)
        assert isinstance(taken, int)
        epoch = taken
    writer = store.writer()
    right: list[Change] = [made("test", epoch), Entry("test", 1, GuidanceChanged({"note": "a"}), epoch)]
    await commit_changes(writer, right)
    # A transaction may be repeated.
    await commit_changes(writer, right)
    right += [Entry("test", seq, GuidanceChanged({"note": "old"}), epoch) for seq in (2, 3, 4)]
    await commit_changes(writer, right)
    own = [Entry("test", seq, GuidanceChanged({"note": f"own {seq}"}), epoch) for seq in (1, 2)]
    await commit_changes(writer, [made("test", epoch, seed=7), *own])
    # Its checkpoint after event 1 ends what the earlier one had beyond event 2.
    await commit_changes(writer, [Checkpoint("test", 1, pack({"of": "its own"}), epoch, 2)])
    kept = store.load("test")
    assert kept is not None
    assert (kept.seq, kept.state, kept.events) == (2, {"of": "its own"}, [GuidanceChanged({"note": "own 2"})])
    assert kept.asked_for == MissionSpec(seed=7)
    writer.close()
    store.close()
