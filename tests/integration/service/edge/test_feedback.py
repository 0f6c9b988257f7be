"""What is learned of outcomes, and when."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.config.settings import Settings
from service.edge.engine import Engine
from service.edge.feedback import Feedback, LearningQueue
from service.live.broadcaster import Broadcaster
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, MissionLog, NullJournal
from shared.wire.schemas import MissionSpec, Outcome
from shared.world.step_rule import Action
from tests.support.asking import PATHS, decide
from tests.support.missions import attended, uav
from tests.support.stored_missions import fly, running, same, state, wait_for_updates

Report = Callable[..., dict[str, Any]]

# What of a mission's state has decisions' IDs in it, which are random.
_NAMED = {"reservations", "pending", "applied", "idempotent_answers", "records", "trust"}


def test_the_same_flight_learns_the_same(tmp_path: Path, report: Report) -> None:
    """A lesson's place among the decisions is the outcome's, not a matter of which thread is faster."""

    def flown(name: str) -> tuple[dict[str, Any], list[int]]:
        with running(tmp_path / name) as (client, engine):
            fly(client, report, range(20))
            mission = wait_for_updates(engine, engine.missions.loaded[0], 57)
            unnamed = {key: value for key, value in state(mission).items() if key not in _NAMED}
            return unnamed, mission.records.visits.tolist()

    (one, visits), (other, visits_again) = flown("one.db"), flown("other.db")
    assert visits == visits_again
    assert same(one, other)
    assert one["learner"]["updates"] == 57


def test_an_outcome_is_learned_after_the_decision_that_it_came_with(tmp_path: Path, report: Report) -> None:
    def told_by(client: httpx.Client, engine: Engine, cost: float | None) -> tuple[list[Any], Mission]:
        first = client.post("/decide", json=report(step=1)).json()
        outcome = {} if cost is None else {"outcome": {"decision_id": first["decision_id"], "cost": cost}}
        second = client.post("/decide", json=report(step=2) | outcome).json()
        return second["top_k"], engine.missions.loaded[0]

    with running(tmp_path / "with.db") as (client, engine):
        taught, mission = told_by(client, engine, 7.0)
        wait_for_updates(engine, mission, 1)
        later = client.post("/decide", json=report(step=2)).json()["top_k"]
    with running(tmp_path / "without.db") as (client, engine):
        untaught, _ = told_by(client, engine, None)
    assert taught == untaught
    assert later != taught


@pytest.mark.parametrize("path", PATHS)
def test_a_request_that_comes_at_once_decides_with_every_earlier_outcome_learned(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """The event loop may read the next request before it trains: here it never trains by itself."""
    monkeypatch.setattr(LearningQueue, "train_some", lambda queue: None)
    with running(tmp_path / "busy.db") as (client, engine):
        [first] = decide(client, path, report(step=1))
        outcome = {"outcome": {"decision_id": first["decision_id"], "cost": 7.0}}
        decide(client, path, report(step=2) | outcome)
        mission = engine.missions.loaded[0]
        assert mission.learner.updates == 0
        decide(client, path, report(step=3))
        assert mission.learner.updates == 1


def test_a_checkpoint_has_learned_from_every_outcome_that_it_replaces(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here one is due after every answer, and the event loop never trains by itself."""
    due, checkpoint, learned = Journal.due, Journal.checkpoint, dict[int, int]()

    def noted(journal: Journal, mission_log: MissionLog, written: dict[str, Any]) -> None:
        learned.setdefault(written["feedback"], written["learner"]["updates"])
        checkpoint(journal, mission_log, written)

    monkeypatch.setattr(LearningQueue, "train_some", lambda queue: None)
    monkeypatch.setattr(Journal, "due", lambda journal, mission, least=1: due(journal, mission, 1))
    monkeypatch.setattr(Journal, "checkpoint", noted)
    with running(tmp_path / "m.db") as (client, _):
        for step in range(2):
            outcome = {"decision_id": client.post("/decide", json=report(step=step)).json()["decision_id"], "cost": 7.0}
            assert client.post("/feedback", json=outcome).json()["result"] == "applied"
    assert learned == {0: 0, 1: 1, 2: 2}


@pytest.mark.long
def test_as_many_lessons_are_learned_as_outcomes_come() -> None:
    """Of many UAVs that ask at once, each turn of the event loop brings many outcomes: none is left out for that."""
    turns = 30

    async def flown() -> list[int]:
        outcomes = Feedback(Metrics(), NullJournal(), Broadcaster())
        fleets = [Mission(f"fleet{n}", MissionSpec(mode="value"), Settings(mode="value")) for n in range(40)]
        for turn in range(turns):
            for mission in fleets:
                name = uuid.uuid4().hex
                mission.commit(attended(mission, uav(), turn).pending(name, Action(1, 7)))
                outcomes.apply(mission, Outcome(decision_id=name, cost=0.5))
            await asyncio.sleep(0)
        outcomes.finish()
        return [mission.learner.updates for mission in fleets]

    assert asyncio.run(flown()) == [turns] * 40
