"""Statistics over decisions."""

from __future__ import annotations

import pytest

from simulator.records.decision import Decision, jain_index, visits_per_sensor


def decision(**changes: object) -> Decision:
    base = {"step": 0, "uav_id": 0, "position": (1.0, 2.0), "sensor_id": 0, "velocity": 3, "source": "onboard"}
    return Decision.model_validate({**base, **changes})


def test_jains_index() -> None:
    assert jain_index([3, 3, 3]) == pytest.approx(1)
    assert jain_index([5, 0, 0, 0]) == pytest.approx(1 / 4)
    assert jain_index([0, 0]) is None
    assert visits_per_sensor([decision(), decision(failed=True), decision(sensor_id=2)], 3) == [1, 0, 1]
