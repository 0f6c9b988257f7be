"""A mission from take-off to its report."""

from __future__ import annotations

from shared.world.scenario import Scenario
from simulator.flying.job import new_mission_id

SHORT = Scenario(steps=4)


def test_mission_ids_differ() -> None:
    first, second = (new_mission_id(SHORT, 0) for _ in range(2))
    assert first.startswith("paper-0-") and first != second
