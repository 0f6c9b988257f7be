"""MissionRegistry that outlive the process: what is read back is what was, to the bit."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.mission_answers import status_of
from service.config.settings import Settings
from service.edge.stored_missions import restore_mission
from service.storage import group_commit, journal
from service.storage.store import Store
from tests.support.stored_missions import (
    copy_of,
    fly,
    locked,
    running,
    same,
    state,
    wait_for_updates,
    wait_until_written,
)
from tests.support.waiting import PATIENCE_S, until

Body = dict[str, Any]
Report = Callable[..., Body]


@pytest.mark.parametrize("mode", ["value", "guided", "policy", "llm"])
@pytest.mark.parametrize("events", [10_000, 25])
def test_what_is_on_disk_is_the_mission_with_and_without_checkpoints(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch, mode: str, events: int
) -> None:
    monkeypatch.setattr(journal, "EVENTS", events)
    monkeypatch.setattr("service.storage.journal.Journal.due.__defaults__", (events,))
    settings = Settings(mode=mode, llm_gguf=Path("none"))
    with running(tmp_path / "m.db", mode=mode, llm_gguf="none", planner_ms=20) as (client, engine):
        spec = {"seed": 3, "note": "visit sensor 2 every fourth step", "mode": mode, "prompt": {"selection": "best"}}
        client.put("/missions/test", json=spec)
        answer = {"guidance": {"sensors": [{"sensor_id": 2, "visit_every": 4}]}}
        assert client.post("/missions/test/guidance", json=answer).status_code == 200
        fly(client, report, range(20))
        mission = wait_for_updates(engine, engine.missions.loaded[0], 57)
        wait_until_written(engine)
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
    again = restore_mission("test", kept, settings)
    after = state(again)
    store.close()
    assert [name for name in before if not same(before[name], after[name])] == []
    assert status_of(again) == status_of(mission)


def test_a_restarted_edge_flies_on(address: str, report: Report) -> None:
    with running(address) as (client, _):
        unreported = fly(client, report, range(5))
        # Lessons come after the answers.
        until(lambda: client.get("/missions/test").json()["learner_updates"] == 12)
        before = client.get("/missions/test").json()
    with running(address, top_k=2, mode="policy") as (client, engine):
        assert engine.missions.loaded == []
        assert client.get("/missions/test").json() == before
        # The outcomes of decisions from before the restart are known.
        fly(client, report, range(5, 8), unreported)
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
        assert len(engine.missions.loaded) == 20


def test_while_the_store_is_locked_decisions_go_on_and_feedback_is_refused(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(group_commit, "LONGEST_PAUSE_S", 0.25)
    with running(tmp_path / "m.db") as (client, engine):
        unreported = fly(client, report, range(3))
        other = locked(tmp_path / "m.db")
        try:
            first = client.post("/decide", json=report(step=3, outcome=unreported[0]))
            assert (first.status_code, first.json()["stored"]) == (200, False)
            # No answer waits for a store that is known to fail: each wait would take two minutes here.
            for step in range(4, 40):
                answer = client.post("/decide", json=report(step=step))
                assert (answer.status_code, answer.json()["stored"]) == (200, False)
            refused = client.post("/feedback", json={"mission_id": "test", **unreported[1]})
            assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
            assert client.get("/healthz").status_code == 200
            assert "aicvds_store_failures_total 0.0" not in client.get("/metrics").text
        finally:
            other.execute("ROLLBACK")
            other.close()
        until(lambda: not engine.journal.failing)
        # What was told with a decision has been written meanwhile; what was refused was not applied.
        first_again = client.post("/feedback", json={"mission_id": "test", **unreported[0]})
        assert (first_again.status_code, first_again.json()["result"]) == (200, "duplicate")
        again = client.post("/feedback", json={"mission_id": "test", **unreported[1]})
        assert (again.status_code, again.json()["result"]) == (200, "applied")
        assert client.post("/decide", json=report(step=41)).json()["stored"] is True
        before = client.get("/missions/test").json()
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json() == before


def test_an_outcome_is_acknowledged_no_sooner_than_it_is_on_disk_and_one_sent_again_neither(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def not_yet(_timeout_s: float) -> bool:
        return False

    with running(tmp_path / "m.db") as (client, engine):
        outcome = fly(client, report, range(1))[0]
        for named in ({"mission_id": "test"}, {}):
            with monkeypatch.context() as slow:
                slow.setattr(engine.journal, "stored", not_yet)
                answers = [client.post("/feedback", json={**named, **outcome}) for _ in range(2)]
            assert [answer.status_code for answer in answers] == [503, 503]
            assert answers[0].json()["errors"][0]["field"] == "decision_id"
            again = client.post("/feedback", json={**named, **outcome})
            assert (again.status_code, again.json()["result"]) == (200, "duplicate")


def test_what_waits_for_a_store_that_fails_is_bounded(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.storage.journal.Journal.due.__defaults__", (20,))
    with running(tmp_path / "m.db") as (client, engine):
        fly(client, report, range(3))
        other = locked(tmp_path / "m.db")
        try:
            for step in range(3, 80):
                assert client.post("/decide", json=report(step=step)).status_code == 200
            assert isinstance(engine.journal, journal.Journal)
            assert len(engine.journal._commits._queue) < 50
        finally:
            other.execute("ROLLBACK")
            other.close()
        before = client.get("/missions/test").json()
    with running(tmp_path / "m.db") as (client, _):
        assert client.get("/missions/test").json() == before


@pytest.mark.long
def test_a_full_disk_loses_nothing_acknowledged(tmp_path: Path, report: Report) -> None:
    """A process of its own whose files may not grow past a limit, which it meets in mid-mission."""
    script = (
        "import resource, sys, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from service.commands.serve import main\n"
        "sys.exit(main(['--port', '0']))\n"
    )
    path = tmp_path / "m.db"
    env = {**os.environ, "AICVDS_STORE": str(path), "AICVDS_MODE": "value"}
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True, env=env)
    assert process.stderr is not None
    try:
        url = process.stderr.readline().split()[4].rstrip(",")
        acknowledged, refused, unreported = [], 0, None
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            for step in range(120):
                answer = client.post("/decide", json=report(step=step))
                assert answer.status_code == 200, answer.text
                if unreported is not None:
                    reported = client.post("/feedback", json={"mission_id": "test", **unreported})
                    assert reported.status_code in (200, 503)
                    if reported.status_code == 200:
                        acknowledged.append(unreported["decision_id"])
                    else:
                        refused += 1
                unreported = {"decision_id": answer.json()["decision_id"], "cost": 0.5}
        assert acknowledged
        assert refused > 10
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    with running(path) as (client, engine):
        status = client.get("/missions/test").json()
        assert status["feedback"] >= len(acknowledged)
        applied = engine.missions.loaded[0].pending.applied
        assert all(name in applied for name in acknowledged[-20:])


def test_missions_that_begin_together_are_not_checkpointed_all_at_once(tmp_path: Path) -> None:
    """A checkpoint takes a millisecond of the event loop, and hundreds of fleets may fly in step."""
    with running(tmp_path / "m.db") as (client, engine):
        for n in range(20):
            assert client.put(f"/missions/fleet{n}", json={"mode": "value"}).status_code == 200
        assert isinstance(engine.journal, journal.Journal)
        least = {
            next(n for n in range(journal.EVENTS, -1, -1) if engine.journal.due(mission, n) is not None)
            for mission in engine.missions.loaded
        }
    assert len(least) > 10
