"""Who has a SQLite file, one edge at a time; and a PostgreSQL that keeps an edge waiting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import create_engine, text

from service.storage.locks import StoreUnusable
from service.storage.store import Store
from tests.support.processes import serving_edge
from tests.support.stored_missions import stored_decision
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]


def test_two_edges_do_not_share_a_file(tmp_path: Path) -> None:
    address = str(tmp_path / "m.db")
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


@contextmanager
def _locking(url: str, table: str) -> Iterator[None]:
    """As a backup or a migration does for a while."""
    other = create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    with other.connect() as db:
        db.execute(text(f"LOCK TABLE {table} IN ACCESS EXCLUSIVE MODE"))
        yield
        db.rollback()
    other.dispose()


@pytest.mark.long
def test_an_edge_ends_though_postgresql_waits_for_a_lock(postgres: str, report: Report) -> None:
    with (
        serving_edge(AICVDS_STORE=postgres, AICVDS_MODE="value") as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        stored_decision(client, report())
        with _locking(postgres, "journal"):
            reported = client.post("/decide", json=report(step=1)).json()
            assert not reported["stored"]
            outcome = {"mission_id": "test", "decision_id": reported["decision_id"], "cost": 1.0}
            assert client.post("/feedback", json=outcome).status_code == 503
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
