"""What sensors said of themselves comes back to the bit: from events, and from a checkpoint and events."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.config.settings import Settings
from service.edge.stored_missions import restore_mission
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal
from service.storage.rows import decode, pack
from service.storage.store import Store
from shared.wire.readings import SensorReading
from shared.wire.schemas import MissionSpec
from tests.integration.service.storage.test_learned_world import SENSORS, Flight, the_same
from tests.support.stored_missions import state
from tests.support.waiting import PATIENCE_S


def say(mission: Mission, number: int) -> list[str]:
    """Every sensor says what its queue is, of a time that is older for some than what is known."""
    ages = [0.0, 3.0, 17.5, 40.0, 400.0]
    return [
        str(result)
        for result in mission.read(
            [
                SensorReading(
                    sensor_id=sensor,
                    queue=(7.0 * sensor + number) % 60,
                    battery=None if sensor % 2 else 40.0 - number,
                    age_s=ages[(sensor + number) % len(ages)],
                    message_id=f"{sensor}-{number // 2}",
                )
                for sensor in range(SENSORS)
            ]
        )
    ]


@pytest.mark.parametrize("checkpointed", [False, True], ids=["events alone", "a checkpoint and events"])
async def test_a_restored_mission_knows_what_its_sensors_said(tmp_path: Path, checkpointed: bool) -> None:
    store, settings = Store(str(tmp_path / "m.db")), Settings(mode="value")
    journal = Journal(store, Metrics())
    mission = Mission("test", MissionSpec(mode="value", planner="off"), settings)
    journal.begin(mission)
    flight, results = Flight(mission), set[str]()
    for number in range(6):
        flight.fly(range(2 * number, 2 * number + 2))
        results |= set(say(mission, number))
        if checkpointed and number == 3:
            track = journal.due(mission, 1)
            assert track is not None
            journal.checkpoint(track, state(mission))
    assert await journal.stored(PATIENCE_S)
    kept = store.load("test")
    assert kept is not None
    assert (kept.state is not None) == checkpointed
    assert results == {"merged", "outdated", "duplicate"}
    the_same(mission, restore_mission("test", kept, settings))
    assert await journal.close(PATIENCE_S)
    store.close()


def test_a_damaged_event_is_refused() -> None:
    with pytest.raises(ValueError, match="damaged event read"):
        decode("read", pack([[1, 2]]))
    with pytest.raises(ValueError, match="checksum"):
        decode("read", pack([[1, 2]]).replace(b"\x02", b"\x03"))
