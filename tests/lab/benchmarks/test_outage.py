"""Missions with and without an outage fly the same worlds over a real edge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_worlds_are_flown_with_an_outage_and_without(tmp_path: Path) -> None:
    lost = figures("lab.benchmarks.outage", "--seeds", "1", "--steps", "10", out=tmp_path / "outage.json")
    assert set(lost) == {"none", "7 m/s", "in place", "last decided"}
    assert all(len(packets) == 1 and packets[0] >= 0 for packets in lost.values())
