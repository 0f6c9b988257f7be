"""What a store can be opened, and by whom."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from service.hold import StoreUnusable
from service.store import SCHEMA, Store
from tests.service.keeping import fly, running

Body = dict[str, Any]
Report = Callable[..., Body]


def test_two_edges_do_not_share_a_store(address: str) -> None:
    first = Store(address)
    with pytest.raises(StoreUnusable, match="another edge"):
        Store(address)
    first.close()
    Store(address).close()


def _damaged(path: Path) -> None:
    path.write_bytes(b"this is no database, whatever its name says" * 100)


def _newer(path: Path) -> None:
    Store(str(path)).close()
    with sqlite3.connect(path) as db:
        db.execute("UPDATE alembic_version SET version_num = '9999'")
    db.close()


@pytest.mark.parametrize(("spoil", "said"), [(_damaged, "not a database"), (_newer, "newer version")])
def test_a_store_that_cannot_be_used_is_refused_with_the_reason(
    tmp_path: Path, spoil: Callable[[Path], None], said: str
) -> None:
    spoil(tmp_path / "m.db")
    with pytest.raises(StoreUnusable, match=said):
        Store(str(tmp_path / "m.db"))


@pytest.mark.parametrize(
    "url",
    [
        "mysql://u:hunter2@h/d",
        "sqlite://",
        "sqlite:///:memory:",
        "nope://x",
        "postgresql://u:p@12:hunter2@127.0.0.1/d",
        "postgresql://u:p@hunter2@h/d",
        "postgresql://u:hunter2@127.0.0.1:1/d",
    ],
)
def test_an_address_that_is_none_is_refused_and_no_password_is_told(url: str) -> None:
    with pytest.raises(StoreUnusable) as refused:
        Store(url)
    assert "hunter2" not in str(refused.value)


def test_the_schema_is_the_migrations_newest() -> None:
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", "service/migrations")
    config.set_main_option("path_separator", "os")
    assert ScriptDirectory.from_config(config).get_current_head() == SCHEMA


def test_a_store_of_an_older_version_is_brought_up_to_date_with_its_missions(tmp_path: Path, report: Report) -> None:
    from alembic import command
    from alembic.config import Config

    file = tmp_path / "m.db"
    with running(file) as (client, _):
        fly(client, report, range(3))
        flown = client.get("/missions/test").json()
    config = Config()
    config.set_main_option("script_location", "service/migrations")
    config.set_main_option("path_separator", "os")
    engine = create_engine(f"sqlite:///{file}")
    with engine.begin() as older:
        config.attributes["connection"] = older
        command.downgrade(config, "0001")
    with running(file) as (client, _):
        assert client.get("/missions/test").json() == flown
    with engine.connect() as newer:
        assert newer.scalar(text("SELECT version_num FROM alembic_version")) == SCHEMA
    engine.dispose()


def _break_holds(url: str) -> None:
    """As a network that fails does: PostgreSQL ends the connection that has the lock."""
    root = create_engine(url.replace("postgresql://", "postgresql+psycopg://"), isolation_level="AUTOCOMMIT")
    holders = "SELECT pid FROM pg_locks WHERE locktype = 'advisory'"
    with root.connect() as db:
        db.execute(text(f"SELECT pg_terminate_backend(pid) FROM ({holders}) AS holders"))
    root.dispose()


def test_an_edge_whose_hold_on_postgresql_broke_takes_it_again_or_writes_no_more(postgres: str, report: Report) -> None:
    with running(postgres) as (client, _):
        client.delete("/missions/test")
        fly(client, report, range(2))
        _break_holds(postgres)
        # Nobody else came: the first write finds out, the next takes the hold again.
        ends = time.monotonic() + 30
        while not client.post("/decide", json=report(step=5)).json()["stored"]:
            assert time.monotonic() < ends
            time.sleep(0.1)
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
        ends = time.monotonic() + 30
        while "another edge has had it since" not in caplog.text:
            assert time.monotonic() < ends
            late = first.post("/decide", json=report(step=9)).json()
            assert not late["stored"]
            time.sleep(0.1)
        outcome = {"mission_id": "test", "decision_id": late["decision_id"], "cost": 0.5, "failed": False}
        assert first.post("/feedback", json=outcome).status_code == 503
    with running(postgres) as (third, _):
        assert third.get("/missions/test").json() == flown
