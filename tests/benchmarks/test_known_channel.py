"""Planners that know more of a shadowed world fly the same worlds as the one that learns it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks.running import ROOT, figures


@pytest.mark.long
def test_every_planner_flies_the_same_worlds_and_knows_something_else(tmp_path: Path) -> None:
    found = figures("known_channel", "--worlds", "2", "--first", "508", out=tmp_path / "known_channel.json")
    assert found["seeds"] == [508, 509]
    steps = {row["scheme"]: row["steps"] for row in found["rows"]}
    assert list(steps) == ["mpc", "known_kind", "known_own", "true_links"]
    assert all(len(world) == 30 and min(world) >= 0 for worlds in steps.values() for world in worlds)
    # Four planners that lost the same packets in the same steps would have known the same.
    assert len({str(worlds) for worlds in steps.values()}) == 4
    assert sum(map(sum, steps["true_links"])) < sum(map(sum, steps["mpc"]))


def test_a_world_without_shadowing_is_refused(tmp_path: Path) -> None:
    command = [sys.executable, "benchmarks/known_channel.py", "--scenario", "paper", "--out", str(tmp_path / "x.json")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and "--scenario paper: choose one with both kinds" in done.stderr
