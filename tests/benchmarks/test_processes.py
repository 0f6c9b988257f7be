"""benchmarks/processes.py at its smallest: it measures what it says, of real edges, and writes it down."""

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_it_tells_decisions_a_second_of_one_process_and_of_two(tmp_path: Path) -> None:
    little = ("--rounds", "1", "--seconds", "0.2", "--uavs", "2", "--missions", "4", "--stores", "none")
    found = figures("processes", *little, out=tmp_path / "processes.json")
    assert [(row["store"], row["connections"]) for row in found["rows"]] == [("none", "kept"), ("none", "new")]
    for row in found["rows"]:
        assert row["ratio"][0] > 0 and row["cost_ratio"][0] > 0
        for processes in "12":
            figure = row[processes]
            assert figure["rate"] > 0 and figure["deciding"] > 0
            assert 0 < figure["p50"] <= figure["p99"]
