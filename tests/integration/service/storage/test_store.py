"""What a store can be opened, and by whom."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from alembic.config import Config

from service.storage.locks import StoreUnusable, sqlite_file
from service.storage.rows import SCHEMA
from service.storage.store import Store


def _damaged(path: Path) -> None:
    path.write_bytes(b"this is no database, whatever its name says" * 100)


def _of_schema(version: str, path: Path) -> None:
    Store(str(path)).close()
    with sqlite3.connect(path) as db:
        db.execute("UPDATE alembic_version SET version_num = ?", [version])
    db.close()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_damaged, "not a database"),
        (partial(_of_schema, "9999"), "newer version"),
        (partial(_of_schema, "0004"), "made before the first release"),
    ],
)
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
        "postgresql://u:p/hunter2@h/d",
        "postgresql://hunter2:p/1@h/d",
        "postgresql:/u:hunter2@h/d",
        "postgresql://u:12/ss?hunter2=x@h/d",
        "postgresql://u:1/b?connect_timeout=hunter2@h/d",
        "postgresql://u:%ffhunter2@127.0.0.1:1/d",
        "postgresql://u:hunter2\udcff@127.0.0.1:1/d",
        "postgresql://u:hunter2@127.0.0.1:1/d",
    ],
)
def test_an_address_that_is_none_is_refused_and_no_password_is_told(url: str) -> None:
    with pytest.raises(StoreUnusable) as refused:
        Store(url)
    assert "hunter2" not in str(refused.value)


@pytest.mark.parametrize("scheme", ["postgresql", "postgres", "postgresql+psycopg"])
def test_an_address_is_read_as_postgresqls_own_programs_read_it(postgres: str, scheme: str) -> None:
    folder = parse_qs(urlsplit(postgres).query)["host"][0].replace("/", "%2F")
    # No server listens at the first address.
    url = f"{scheme}://postgres@%2Fnowhere:5433,{folder}:5432/postgres?target_session_attrs=read-write"
    store = Store(f"{url}&application_name=edge")
    assert store.leases is not None
    store.close()


def _migrations() -> Config:
    config = Config()
    config.set_main_option("script_location", "service/storage/migrations")
    config.set_main_option("path_separator", "os")
    return config


def test_the_schema_is_the_migrations_newest() -> None:
    from alembic.script import ScriptDirectory

    config = _migrations()
    assert ScriptDirectory.from_config(config).get_current_head() == SCHEMA


def test_a_home_that_there_is_not_is_named() -> None:
    with pytest.raises(StoreUnusable, match="home directory"):
        Store("~nobody_of_this_name/m.db")
    assert sqlite_file("~nobody_of_this_name/m.db") == "~nobody_of_this_name/m.db"
