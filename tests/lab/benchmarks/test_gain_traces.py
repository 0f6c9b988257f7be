"""Worlds with traces like measured ones are flown by every scheme, and the map's error ahead is compared."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_every_scheme_flies_the_traces_and_the_map_is_better_than_the_formula(tmp_path: Path) -> None:
    found = figures("lab.benchmarks.gain_traces", "--seeds", "1", "--scales", "0.7", out=tmp_path / "gain_traces.json")
    (world,) = found["worlds"]
    lost = world["lost_packets"]
    assert {"policy", "mpc", "mpc_formula", "longest_queue", "longest_queue_fast", "nearest_fast"} <= set(lost)
    assert all(len(packets) == 1 and packets[0] >= 0 for packets in lost.values())
    # Slow flights lose many more packets than a plan.
    assert lost["policy"][0] < lost["max_gain"][0]
    for errors in world["ahead"].values():
        by_map, by_formula = errors[0]
        # The standard deviations are 0.7 times 8 to 16 dB.
        assert 0 < by_map < by_formula and 5.0 < by_formula < 12.0
