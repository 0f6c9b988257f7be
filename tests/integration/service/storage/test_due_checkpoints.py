"""When a mission's checkpoint is due: by the work of replaying its events since the last one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from service.config.settings import Settings
from service.learning.modules import Sample
from service.mission.decisions import Pending
from service.mission.events import Decided, Event, Reported, Settled
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import EVENTS, Journal
from service.storage.leases import LeaseLost
from service.storage.operations import Change, Done
from service.storage.store import StoredMission
from shared.wire.schemas import MissionSpec, Outcome
from shared.world.scenario import SCENARIOS
from tests.support.missions import uav
from tests.support.storing import StoreHere
from tests.support.waiting import PATIENCE_S, soon

SMALL = SCENARIOS["paper"]
REPORTED = Reported(0, uav())


@pytest.fixture
async def store(tmp_path: Path) -> AsyncIterator[StoreHere]:
    store = StoreHere(tmp_path / "m.db")
    yield store
    store.close()


@pytest.fixture
async def journal(store: StoreHere) -> AsyncIterator[Journal]:
    journal = Journal(store, Metrics())
    yield journal
    assert await journal.close(PATIENCE_S)


def flown(sensors: int = SMALL.sensors, name: str = "test") -> Mission:
    scenario = SMALL.model_copy(update={"sensors": sensors})
    return Mission(name, MissionSpec(mode="value", scenario=scenario), Settings(mode="value"))


def decided(sensors: int | None) -> Decided:
    """A decision among this number of sensors; None: the modules had no part in it."""
    sample = None if sensors is None else Sample(np.zeros((sensors, 4), np.float32), 0, np.zeros(4, np.float32), 3)
    return Decided(Pending("a" * 32, 0, 0, 1, 3, (), sample), 0, None)  # type: ignore[arg-type]


def weight(journal: Journal, mission: Mission) -> int:
    """The weight of the events since the last checkpoint, which this makes anew."""
    return next(n for n in range(10 * EVENTS, -1, -1) if journal.due(mission, n) is not None)


async def test_after_a_checkpoint_the_events_are_counted_anew(journal: Journal) -> None:
    mission = flown()
    journal.begin(mission)
    weight(journal, mission)
    for _ in range(2):
        for _ in range(EVENTS - 1):
            mission.record(REPORTED)
        assert journal.due(mission) is None
        mission.record(REPORTED)
        assert journal.due(mission) is not None


@pytest.mark.parametrize(
    ("sensors", "event", "expected"),
    [
        (SMALL.sensors, decided(SMALL.sensors), 1),
        (100, decided(99), 1),
        (100, decided(100), 2),
        (250, decided(250), 3),
        (250, decided(None), 1),
        (250, REPORTED, 1),
        (250, Settled(Outcome(decision_id="a" * 32, cost=0.0), True), 1),
    ],
)
async def test_a_decision_counts_for_one_event_more_every_hundred_sensors(
    journal: Journal, sensors: int, event: Event, expected: int
) -> None:
    mission = flown(sensors)
    journal.begin(mission)
    weight(journal, mission)
    for _ in range(2):
        mission.record(event)
    assert weight(journal, mission) == 2 * expected


async def test_a_restored_mission_begins_with_the_weight_of_the_replayed_events(journal: Journal) -> None:
    mission = flown(250)
    journal.resume(mission, 7, [REPORTED, decided(250), decided(None)])
    assert weight(journal, mission) == 5


async def test_no_checkpoint_of_an_earlier_mission_of_the_same_name_is_due(journal: Journal) -> None:
    earlier, mission = flown(), flown()
    journal.begin(earlier)
    journal.end("test")
    journal.begin(mission)
    mission.record(REPORTED)
    assert journal.due(earlier, 0) is None
    assert journal.due(mission, 1) is not None


async def test_a_late_checkpoint_of_a_deleted_mission_is_not_written(store: StoreHere, journal: Journal) -> None:
    earlier, mission = flown(), flown()
    journal.begin(earlier)
    late = journal.due(earlier, 0)
    assert late is not None
    journal.end("test")
    journal.begin(mission)
    journal.checkpoint(late, earlier.state_dict())
    assert await journal.stored(PATIENCE_S)
    kept = store.load("test")
    assert kept is not None and kept.state is None


async def test_a_large_missions_checkpoint_replaces_no_event_that_came_while_it_was_packed(
    store: StoreHere, journal: Journal
) -> None:
    mission = flown(1000)
    journal.begin(mission)
    mission.record(REPORTED)
    log = journal.due(mission, 0)
    assert log is not None
    journal.checkpoint(log, {"step": 0})
    mission.record(REPORTED)

    def kept() -> StoredMission | None:
        found = store.load("test")
        return found if found is not None and found.state is not None else None

    written = await soon(kept)
    assert await journal.stored(PATIENCE_S)
    assert written is not None and written.state == {"step": 0}
    kept_now = store.load("test")
    assert kept_now is not None and kept_now.events == [REPORTED]


class TakenOver:
    """The writer of a store in which another edge has had the mission after these epochs."""

    def __init__(self, *epochs: int) -> None:
        self._epochs = epochs

    def write(self, changes: Sequence[Change], done: Done) -> None:
        lost = {("test", epoch) for epoch in self._epochs if any(change.epoch == epoch for change in changes)}
        asyncio.get_running_loop().call_soon(done, LeaseLost(lost) if lost else None)

    def close(self) -> None:
        """Nothing is open."""


@pytest.mark.parametrize(("epochs", "ended"), [((1,), []), ((1, 3), ["test"])])
async def test_a_mission_taken_back_does_not_end_with_the_changes_of_its_earlier_lease(
    store: StoreHere, monkeypatch: pytest.MonkeyPatch, epochs: tuple[int, ...], ended: list[str]
) -> None:
    monkeypatch.setattr(store, "writer", lambda: TakenOver(*epochs))
    journal, lost = Journal(store, Metrics()), list[str]()
    journal.on_lost = lost.append
    earlier, mission = flown(), flown()
    journal.begin(earlier, epoch=1)
    journal.drop("test")
    journal.resume(mission, 7, [], epoch=3)
    mission.record(REPORTED)
    assert await journal.stored(PATIENCE_S)
    assert journal.lost(earlier)
    assert (lost, journal.lost(mission)) == (ended, bool(ended))
    assert await journal.close(PATIENCE_S)
