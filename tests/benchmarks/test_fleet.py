"""benchmarks/fleet.py at its smallest: it measures what it says, of real edges, and writes it down."""

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_it_tells_decisions_a_second_memory_and_what_learning_costs(tmp_path: Path) -> None:
    little = ("--missions", "1", "3", "--decisions", "9", "--each", "6", "--veterans", "1", "--lifetime", "9")
    paced = ("--pace", "50", "--block", "5", "--rounds", "1")
    found = figures("benchmarks.fleet", *little, *paced, out=tmp_path / "fleet.json")
    for rate in found["rates"].values():
        assert rate["decisions_a_s"] > 0
        assert 0 < rate["p50_ms"] <= rate["p99_ms"]
    assert found["learning"]["with_outcomes"]["p99_ms"] > 0 < found["learning"]["without"]["p99_ms"]
    assert found["memory"]["missions"] == 3
    assert found["memory"]["kb_a_mission"] > 0
