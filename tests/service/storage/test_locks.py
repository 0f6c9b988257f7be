"""Who has a store: one edge at a time, and none that another has followed."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError

from service.storage.locks import StoreUnusable
from service.storage.operations import Deleted
from service.storage.store import Store
from tests.e2e.processes import serving_edge
from tests.service.keeping import fly, kept, running, written
from tests.waiting import PATIENCE_S, until

Report = Callable[..., dict[str, Any]]


def test_two_edges_do_not_share_a_store(address: str) -> None:
    first = Store(address)
    with pytest.raises(StoreUnusable, match="another edge"):
        Store(address)
    first.close()
    Store(address).close()


def test_a_file_known_by_a_link_is_the_same_store(tmp_path: Path) -> None:
    first = Store(str(tmp_path / "m.db"))
    (tmp_path / "alias.db").symlink_to(tmp_path / "m.db")
    with pytest.raises(StoreUnusable, match="another edge"):
        Store(str(tmp_path / "alias.db"))
    first.close()


def _break_holds(url: str) -> None:
    """As a network that fails does: PostgreSQL ends the connection that has the lock. The lock is free on return."""
    root = create_engine(url.replace("postgresql://", "postgresql+psycopg://"), isolation_level="AUTOCOMMIT")
    holders = "SELECT pid FROM pg_locks WHERE locktype = 'advisory'"
    with root.connect() as db:
        db.execute(text(f"SELECT pg_terminate_backend(pid, 60000) FROM ({holders}) AS holders"))
    root.dispose()


def test_an_edge_whose_hold_on_postgresql_broke_takes_it_again_or_writes_no_more(postgres: str, report: Report) -> None:
    with running(postgres) as (client, _):
        client.delete("/missions/test")
        fly(client, report, range(2))
        _break_holds(postgres)
        # Nobody else came: the first write finds out, the next takes the hold again.
        kept(client, report(step=5))
        with pytest.raises(StoreUnusable, match="another edge"):
            Store(postgres)


def test_an_edge_that_comes_back_after_another_had_the_database_writes_nothing_into_what_that_one_wrote(
    postgres: str, report: Report, caplog: pytest.LogCaptureFixture
) -> None:
    with running(postgres) as (first, _):
        first.delete("/missions/test")
        fly(first, report, range(2))
        _break_holds(postgres)
        with running(postgres) as (second, _):
            fly(second, report, range(2, 4))
            flown = second.get("/missions/test").json()
        # The other has ended, and the lock is free: the first, which was not asked meanwhile, has it as of step 2.
        late: dict[str, Any] = {}

        def refused() -> bool:
            late.update(first.post("/decide", json=report(step=9)).json())
            assert not late["stored"]
            return "another edge has had it since" in caplog.text

        until(refused)
        outcome = {"mission_id": "test", "decision_id": late["decision_id"], "cost": 0.5, "failed": False}
        assert first.post("/feedback", json=outcome).status_code == 503
    with running(postgres) as (third, _):
        assert third.get("/missions/test").json() == flown


@contextmanager
def _locking(url: str, table: str) -> Iterator[None]:
    """As a backup or a migration does for a while."""
    other = create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    with other.connect() as db:
        db.execute(text(f"LOCK TABLE {table} IN ACCESS EXCLUSIVE MODE"))
        yield
        db.rollback()
    other.dispose()


async def test_an_edge_that_was_followed_stays_out_and_lets_a_third_in(
    postgres: str,
) -> None:
    nothing = [Deleted("nobody")]
    first = Store(postgres)
    writer = first.writer()
    _break_holds(postgres)
    Store(postgres).close()
    with pytest.raises(OperationalError, match="terminating connection|closed the connection"):
        await written(writer, nothing)
    with _locking(postgres, "terms"), pytest.raises(OperationalError, match="lock timeout"):
        await written(writer, nothing)
    for _ in range(2):
        with pytest.raises(StoreUnusable, match="another edge has had it since"):
            await written(writer, nothing)
    third = Store(postgres)
    with pytest.raises(StoreUnusable, match="another edge uses"):
        await written(writer, nothing)
    third.close()
    writer.close()
    first.close()


@pytest.mark.long
def test_an_edge_ends_though_postgresql_waits_for_a_lock(postgres: str, report: Report) -> None:
    with (
        serving_edge(AICVDS_STORE=postgres, AICVDS_MODE="value") as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        kept(client, report())
        with _locking(postgres, "journal"):
            told = client.post("/decide", json=report(step=1)).json()
            assert not told["stored"]
            outcome = {"mission_id": "test", "decision_id": told["decision_id"], "cost": 1.0}
            assert client.post("/feedback", json=outcome).status_code == 503
            process.terminate()
            assert process.wait(PATIENCE_S) == -signal.SIGTERM
