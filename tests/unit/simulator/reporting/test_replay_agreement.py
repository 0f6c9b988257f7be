"""The agreement of two missions' decisions, and their costs."""

from __future__ import annotations

from typing import Any

from simulator.records.decision import Decision
from simulator.reporting.replay_agreement import Compared, agreement


def decision(sensor: int, velocity: int, **changes: Any) -> Decision:
    return Decision(
        step=0, uav_id=0, position=(0, 0), sensor_id=sensor, velocity=velocity, **{"source": "llm", **changes}
    )


def test_velocities_a_metre_a_second_apart_agree() -> None:
    pairs = [((1, 7), (1, 7)), ((1, 7), (1, 8)), ((1, 7), (2, 6)), ((1, 7), (1, 9))]
    compared = [Compared(logged=decision(*a), replayed=decision(*b)) for a, b in pairs]
    found = agreement(compared)
    assert (found.sensor_pct, found.velocity_pct, found.both_pct) == (75, 75, 50)
    assert [c.same for c in compared] == [True, False, False, False]
    assert agreement([]).both_pct is None
