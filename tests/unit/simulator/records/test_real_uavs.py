"""What a flight of real UAVs adds to its summary: sums by UAV, and what went otherwise than decided."""

from __future__ import annotations

import pytest

from simulator.records.real_uavs import RealUavs, sums_by_uav
from tests.unit.simulator.records.test_statistics import decision


def test_each_uav_has_the_sums_of_its_own_decisions() -> None:
    decisions = [
        decision(uav_id=2, collected=5, lost_packets=3, rtt_ms=30.0),
        decision(uav_id=0, failed=True),
        decision(uav_id=2, failed=True, lost_packets=4),
        decision(uav_id=2, collected=1, rtt_ms=10.0),
        decision(uav_id=2, rtt_ms=11.0),
    ]
    first, second = sums_by_uav(decisions, {2: (70.0, 68.0)})
    assert first.model_dump() == {
        "uav_id": 0, "decisions": 1, "collected": 0, "failures": 1, "lost_packets": 0, "rtt_ms": None,
        "decided_m": 0.0, "flown_m": 0.0,
    }  # fmt: skip
    assert second.model_dump() == {
        "uav_id": 2, "decisions": 4, "collected": 6, "failures": 1, "lost_packets": 7, "rtt_ms": 11.0,
        "decided_m": 70.0, "flown_m": 68.0,
    }  # fmt: skip


@pytest.mark.parametrize(("flown_m", "warned"), [(940.0, True), (950.0, False), (1050.0, False), (1060.0, True)])
def test_a_way_more_than_a_twentieth_off_the_decided_one_is_a_warning(flown_m: float, warned: bool) -> None:
    uavs = sums_by_uav([decision()], {0: (1000.0, flown_m)})
    facts = RealUavs(uavs=uavs, late=0, undecided={}, not_carried_out=[], simulated_lost=None)
    text = f"Warning: UAV 0 flew {flown_m:,.0f} m where 1,000 m were decided."
    assert facts.remarks() == ([text] if warned else [])
