"""Planners that know more of a shadowed world fly the same worlds as the one that learns it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_every_planner_flies_the_same_worlds_and_knows_something_else(tmp_path: Path) -> None:
    found = figures(
        "lab.benchmarks.known_channel", "--worlds", "2", "--first", "508", out=tmp_path / "known_channel.json"
    )
    assert found["seeds"] == [508, 509]
    steps = {row["scheme"]: row["steps"] for row in found["rows"]}
    assert list(steps) == ["mpc", "known_kind", "known_own", "true_links"]
    assert all(len(world) == 30 and min(world) >= 0 for worlds in steps.values() for world in worlds)
    # Four planners that lost the same packets in the same steps would have known the same.
    assert len({str(worlds) for worlds in steps.values()}) == 4
    assert sum(map(sum, steps["true_links"])) < sum(map(sum, steps["mpc"]))
