"""Missions with beacons and without fly the same worlds over a real edge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_every_mode_flies_with_beacons_and_without(tmp_path: Path) -> None:
    lost = figures("lab.benchmarks.served_only", "--seeds", "1", "--steps", "8", out=tmp_path / "served.json")
    assert set(lost) == {f"{mode}@{w}" for mode in ("policy", "value", "value_reported") for w in ("beacons", "served")}
    assert all(len(packets) == 1 and packets[0] >= 0 for packets in lost.values())
    # Without beacons the fleet decides otherwise.
    assert any(lost[f"{mode}@served"] != lost[f"{mode}@beacons"] for mode in ("policy", "value", "value_reported"))
