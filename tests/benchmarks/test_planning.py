"""Both edges fly the same worlds, and lose the same packets where they are the same edge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures
from tests.support.places import ROOT

pytestmark = pytest.mark.long


def test_an_edge_beside_itself_loses_the_same(tmp_path: Path) -> None:
    same = ROOT
    options = ("--rounds", "1", "--scenarios", "paper", "--modes", "policy", "--before", str(same))
    found = figures("benchmarks.planning", *options, out=tmp_path / "planning.json")
    before, this = found["rows"]
    assert (before["edge"], this["edge"]) == ("before", "this")
    assert this["lost"]["values"] == before["lost"]["values"]
    assert this["lost to before"] == [1.0, 1.0, 1.0]
    assert 0 < this["p50_ms"]["mean"] < this["p95_ms"]["mean"]
    assert this["cpu_ms"]["mean"] > 0
