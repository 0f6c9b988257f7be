"""What may come between: a second life, a store that hangs or fails, a service that is too busy to learn."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.config.settings import Settings
from service.edge import feedback
from service.edge.stored_missions import restore_mission
from service.errors import Refused, Unavailable
from service.learning.learner import Learner
from service.mission.events import Settled
from service.mission.idempotency import IdempotentAnswers
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal
from service.storage.operations import Change, Checkpoint, Done, Entry, WriteFailed, Writer
from service.storage.rows import pack
from service.storage.store import Store, StoredMission
from shared.wire.schemas import DecideRequest, MissionSpec
from shared.world.scenario import Scenario
from tests.support.missions import uav
from tests.support.running import serving
from tests.support.stored_missions import copy_of, fly, locked, running, same, state, wait_for_updates, writers
from tests.support.stub_llm import StubLlm, wait_for
from tests.support.waiting import PATIENCE_S, soon, until

Report = Callable[..., dict[str, Any]]


class Moody:
    """A writer that fails when it is told to, and says what it wrote."""

    def __init__(self, well: Writer) -> None:
        self._writer = well
        self.failures: list[Exception] = []
        self.well = True
        self.written: list[Change] = []

    def write(self, changes: Sequence[Change], done: Done) -> None:
        if self.failures:
            raise self.failures.pop(0)
        if not self.well:
            asyncio.get_running_loop().call_soon(done, WriteFailed("disk full"))
            return
        self.written.extend(changes)
        self._writer.write(changes, done)

    def close(self) -> None:
        self._writer.close()


class MoodyStore(Store):
    """A store with such a writer."""

    def writer(self) -> Moody:
        self.moody = Moody(super().writer())
        return self.moody


async def test_a_checkpoint_stands_where_the_events_stood_that_it_covers(tmp_path: Path) -> None:
    store = MoodyStore(str(tmp_path / "m.db"))
    journal = Journal(store, Metrics())
    writer = store.moody
    mission = Mission("test", MissionSpec(mode="value"), Settings(mode="value"))
    journal.begin(mission)
    for step in range(3):
        mission.observe(uav(step=step), step)
    assert await journal.stored(PATIENCE_S)
    writer.well = False
    for step in range(3, 10):
        mission.observe(uav(step=step), step)
    await soon(lambda: journal.failing)
    track = journal.due(mission, 1)
    assert track is not None
    journal.checkpoint(track, {**mission.state_dict(), "learner": mission.learner.state_dict()})
    for step in range(10, 13):
        mission.observe(uav(step=step), step)
    writer.well = True
    await soon(lambda: not journal.failing and not journal._commits._queue)
    tail = writer.written[4:]
    assert [item.seq for item in tail if isinstance(item, Checkpoint | Entry)] == [10, 11, 12, 13]
    assert isinstance(tail[0], Checkpoint)
    kept = store.load("test")
    assert kept is not None
    assert same(state(restore_mission("test", kept, Settings(mode="value"))), state(mission))
    assert await journal.close(PATIENCE_S)
    store.close()


async def test_a_journal_outlives_any_failure_of_its_store(tmp_path: Path) -> None:
    store = MoodyStore(str(tmp_path / "m.db"))
    journal = Journal(store, Metrics())
    store.moody.failures = [MemoryError(), OSError("no such device")]
    mission = Mission("test", MissionSpec(mode="value"), Settings(mode="value"))
    journal.begin(mission)
    assert not await journal.stored(PATIENCE_S)
    await soon(lambda: not journal.failing)
    assert await journal.stored(PATIENCE_S)
    assert store.missions() == ["test"]
    assert await journal.close(PATIENCE_S)
    store.close()


async def test_a_journal_that_is_closed_writes_no_more_and_starts_nothing(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "m.db"))
    journal = Journal(store, Metrics())
    mission = Mission("test", MissionSpec(mode="value"), Settings(mode="value"))
    journal.begin(mission)
    assert await journal.close(PATIENCE_S)
    mission.observe(uav(step=0), 0)
    assert not await journal.stored(0.05)
    assert writers(os.getpid()) == []
    kept = store.load("test")
    assert kept is not None and kept.events == []
    store.close()


async def test_large_checkpoints_are_written_a_few_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.storage.group_commit.MOST_BYTES", 50_000)
    store = MoodyStore(str(tmp_path / "m.db"))
    journal = Journal(store, Metrics())
    most: list[int] = []
    write = store.moody.write

    def counted(changes: Sequence[Change], done: Done) -> None:
        most.append(sum(isinstance(change, Checkpoint) for change in changes))
        write(changes, done)

    monkeypatch.setattr(store.moody, "write", counted)
    for number in range(9):
        mission = Mission(f"m{number}", MissionSpec(mode="value"), Settings(mode="value"))
        journal.begin(mission)
        mission.observe(uav(step=0), 0)
        track = journal.due(mission, 1)
        assert track is not None
        state = {**mission.state_dict(), "learner": mission.learner.state_dict(), "more": b"x" * 20_000}
        journal.checkpoint(track, state)
    assert await journal.stored(PATIENCE_S)
    assert await journal.close(PATIENCE_S)
    assert sum(most) == 9
    assert max(most) <= 3
    store.close()


@pytest.mark.parametrize(("sensors", "thread"), [(999, "MainThread"), (1000, "checkpoints_0")])
async def test_a_large_checkpoint_is_packed_beside_the_decisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sensors: int, thread: str
) -> None:
    threads: list[str] = []
    at_rest = threading.Event()

    def slowly(value: Any) -> bytes:
        threads.append(threading.current_thread().name)
        assert at_rest.wait(PATIENCE_S)
        return pack(value)

    store = Store(str(tmp_path / "m.db"))
    journal = Journal(store, Metrics())
    spec = MissionSpec(mode="value", scenario=Scenario(name="wide", sensors=sensors))
    mission = Mission("test", spec, Settings(mode="value"))
    journal.begin(mission)
    mission.observe(uav(step=0), 0)
    track = journal.due(mission, 1)
    assert track is not None
    if thread == "MainThread":
        at_rest.set()
    monkeypatch.setattr("service.storage.journal.pack", slowly)
    journal.checkpoint(track, {**mission.state_dict(), "learner": mission.learner.state_dict()})
    # What happens while it is packed is on disk at once, and is not lost when the checkpoint comes after it.
    for step in range(1, 4):
        mission.observe(uav(step=step), step)
    assert await journal.stored(PATIENCE_S)
    at_rest.set()
    assert await journal.close(PATIENCE_S)
    kept = store.load("test")
    assert kept is not None and kept.state is not None and len(kept.events) == 3
    assert same(state(restore_mission("test", kept, Settings(mode="value"))), state(mission))
    assert threads == [thread]
    store.close()


def test_a_store_that_hangs_keeps_no_other_mission_waiting_and_a_sleeping_one_no_longer_than_its_deadline(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path / "m.db") as (client, _):
        for number in range(9):
            client.post("/decide", json=report(mission_id=f"m{number}"))
    load, hung, well = Store.load, threading.Event(), threading.Event()

    def slowly(self: Store, mission_id: str) -> StoredMission | None:
        hung.set()
        assert well.wait(PATIENCE_S)
        return load(self, mission_id)

    monkeypatch.setattr(Store, "load", slowly)
    with (
        running(tmp_path / "m.db", mode="guided", llm_gguf="none", planner="off") as (client, _),
        ThreadPoolExecutor(9) as pool,
    ):
        client.post("/decide", json=report(mission_id="awake"))
        bodies = [report(mission_id=f"m{number}", deadline_ms=100) for number in range(9)]
        sleeping = [pool.submit(client.post, "/decide", json=body) for body in bodies]
        assert hung.wait(PATIENCE_S)
        # Answered at all: the store comes back only after it.
        assert client.post("/decide", json=report(mission_id="awake", step=1)).status_code == 200
        late = [asked.result() for asked in sleeping]
        assert {answer.status_code for answer in late} == {503}
        assert {answer.headers["retry-after"] for answer in late} == {"1"}
        well.set()
        # It wakes all the same.
        until(lambda: client.post("/decide", json=bodies[0]).status_code == 200)


def test_while_the_store_fails_nothing_is_deleted_made_or_confirmed(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        fly(client, report, range(2))
        other = locked(tmp_path / "m.db")
        try:
            client.post("/decide", json=report(step=2))
            # Only what the edge knows can it refuse: a DELETE that comes before is carried out, and told as a 503.
            until(lambda: engine.journal.failing)
            structure = {"guidance": {"max_velocity": 5}}
            assert client.delete("/missions/test").status_code == 503
            assert client.put("/missions/new", json={}).status_code == 503
            assert client.post("/missions/test/guidance", json=structure).status_code == 503
            assert client.get("/missions/test").status_code == 200
            assert client.get("/missions/new").status_code == 404
            assert client.get("/missions/test/guidance").json()["status"] == "none"
        finally:
            other.execute("ROLLBACK")
            other.close()


def test_what_was_not_learned_is_not_learned_when_it_is_read_back(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # Of a batch's three outcomes, which come at once, two can wait.
    monkeypatch.setattr(feedback, "MAX_TASKS", 2)
    monkeypatch.setattr(feedback, "WARNING_S", 3600.0)
    with running(tmp_path / "m.db") as (client, engine):
        unreported: dict[int, str] = {}
        for step in range(6):
            uavs = []
            for uav_id in range(3):
                reported = {"outcome": {"decision_id": unreported[uav_id], "cost": 0.1 * uav_id}} if unreported else {}
                uavs.append(
                    {k: v for k, v in report(uav_id=uav_id).items() if k not in ("mission_id", "step")} | reported
                )
            answer = client.post("/decide/batch", json={"mission_id": "test", "step": step, "uavs": uavs})
            assert answer.status_code == 200, answer.text
            unreported = {decision["uav_id"]: decision["decision_id"] for decision in answer.json()["decisions"]}
        mission = engine.missions.loaded[0]
        assert wait_for_updates(engine, mission, 10).feedback == 15
        # Not a line for each.
        assert sum("falls behind" in line.message for line in caplog.records) == 1
        copied = copy_of(tmp_path / "m.db", tmp_path / "copy.db")
        store = Store(str(copied))
        kept = store.load("test")
        store.close()
        assert kept is not None
        assert same(state(restore_mission("test", kept, Settings(mode="value"))), state(mission))


def test_a_lesson_that_fails_leaves_the_mission_readable(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> float:
        raise RuntimeError("not today")

    with running(tmp_path / "m.db") as (client, engine):
        monkeypatch.setattr(Learner, "update", broken)
        fly(client, report, range(3))
        store = Store(str(copy_of(tmp_path / "m.db", tmp_path / "copy.db")))
        kept = store.load("test")
        store.close()
        assert kept is not None
        assert [event.for_training for event in kept.events if isinstance(event, Settled)] == [True] * 6
        restored = restore_mission("test", kept, Settings(mode="value"))
        assert same(state(restored), state(engine.missions.loaded[0]))
    assert (restored.decisions, restored.feedback, restored.learner.updates) == (9, 6, 0)


async def test_who_waits_for_a_request_that_is_given_up_is_told_to_send_it_again(report: Report) -> None:
    repeats, request = IdempotentAnswers(8), DecideRequest.model_validate(report())
    begun = asyncio.Event()

    async def never() -> str:
        begun.set()
        await asyncio.Event().wait()
        return "never"

    first = asyncio.create_task(repeats.once("k", request, never, lambda _: None))
    await begun.wait()
    second = asyncio.create_task(repeats.once("k", request, never, lambda _: None))
    await asyncio.sleep(0)
    first.cancel()
    with pytest.raises(Unavailable):
        await second
    with pytest.raises(asyncio.CancelledError):
        await first

    async def answer() -> str:
        return "answer"

    assert await repeats.once("k", request, answer, lambda _: None) == "answer"
    with pytest.raises(Refused):
        await repeats.once("k", DecideRequest.model_validate(report(step=1)), answer, lambda _: None)


def test_a_key_is_known_longer_than_the_outcome_that_came_with_it(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        first = client.post("/decide", json=report()).json()
        body = report(step=1, outcome={"decision_id": first["decision_id"], "cost": 0.5})
        answer = client.post("/decide", json=body, headers={"Idempotency-Key": "k"}).json()
        engine.missions.loaded[0].pending.applied.load_state_dict([])
        again = client.post("/decide", json=body, headers={"Idempotency-Key": "k"})
        assert (again.status_code, again.json()["decision_id"]) == (200, answer["decision_id"])
        assert client.get("/missions/test").json()["feedback"] == 1


@pytest.mark.parametrize("form", ["text", "json"])
def test_a_traceback_shows_no_variables(form: str) -> None:
    script = (
        "import logging\n"
        "from service.observability import logs\n"
        f"logs.configure('info', '{form}')\n"
        "def fail(key):\n"
        "    raise ValueError('it failed')\n"
        "try:\n"
        "    fail('sk-' + 'secret')\n"
        "except ValueError:\n"
        "    logging.getLogger('x').exception('caught')\n"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert "it failed" in ran.stderr
    assert "sk-secret" not in ran.stderr
    # Colours are for terminals.
    assert "\x1b" not in ran.stderr


@pytest.mark.parametrize("mode", ["llm", "guided"])
def test_a_mission_whose_prompt_no_longer_fits_flies_on_without_the_llm(
    tmp_path: Path, report: Report, caplog: pytest.LogCaptureFixture, mode: str
) -> None:
    model = StubLlm("A")
    with serving(model.app) as url:
        settings = {"mode": mode, "llm_url": f"{url}/v1"}
        spec = {"prompt": {"experiences": 100}}
        with running(tmp_path / "m.db", **settings, llm_context=131_072) as (client, _):
            assert client.put("/missions/test", json=spec).status_code == 200
            before = client.post("/decide", json=report()).json()
        caplog.clear()
        with running(tmp_path / "m.db", **settings, llm_context=1024, experiences=0) as (client, _):
            wait_for(client, "ready")
            asked = len(model.bodies)
            outcome = {"decision_id": before["decision_id"], "cost": 0.5}
            answer = client.post("/decide", json=report(step=1, outcome=outcome))
            assert answer.status_code == 200, answer.text
            assert (answer.json()["source"], answer.json()["reason"]) == ("policy", "llm_unavailable")
            assert client.get("/missions/test").json()["decisions"] == 2
            assert len(model.bodies) == asked
            assert client.put("/missions/new", json=spec).status_code == 422
    [warned] = [one.getMessage() for one in caplog.records if "AICVDS_LLM_CONTEXT" in one.getMessage()]
    assert warned.startswith("mission test continues without the LLM: prompt: 100 experiences and ")
    assert "AICVDS_LLM_CONTEXT is 1024: raise it" in warned and warned.endswith("; or DELETE it, and make it anew")


def test_a_mission_of_the_adapter_says_why_another_llm_is_not_asked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with running(tmp_path / "m.db", mode="llm", llm_gguf="none", llm_adapter="served") as (client, _):
        assert client.put("/missions/test", json={}).json()["prompt"]["format"] == "compact"
    with running(tmp_path / "m.db", mode="llm", llm_gguf="none", llm_adapter="off") as (client, _):
        assert client.get("/missions/test").status_code == 200
    [warned] = [one.getMessage() for one in caplog.records if "without the LLM" in one.getMessage()]
    assert "compact needs an LLM with an adapter" in warned and "AICVDS_LLM_CONTEXT" not in warned
