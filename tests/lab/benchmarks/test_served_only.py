"""Missions with beacons and without fly the same worlds over a real edge."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from lab.experiments.execution import commit
from tests.benchmarks.running import run

pytestmark = pytest.mark.long


def test_every_mode_flies_with_beacons_and_without(tmp_path: Path) -> None:
    out = tmp_path / "served.csv"
    run("lab.benchmarks.served_only", "--seeds", "1", "--steps", "8", out=out)
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    lost = {(row["scheme"], row["measure"].partition("@")[2]): int(row["value"]) for row in rows}
    modes = ("policy", "value", "value_reported")
    assert set(lost) == {(mode, world) for mode in modes for world in ("beacons", "served")}
    assert {row["commit"] for row in rows} == {commit() or ""}
    # Without beacons the fleet decides otherwise.
    assert any(lost[mode, "served"] != lost[mode, "beacons"] for mode in modes)
