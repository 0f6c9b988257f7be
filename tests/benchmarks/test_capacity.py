"""benchmarks/capacity.py at its smallest: an edge on a PostgreSQL, what a decision costs, and what that predicts."""

from pathlib import Path

import pytest

from benchmarks.capacity import Capacity, modes
from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_it_tells_costs_and_predicts_from_them(tmp_path: Path) -> None:
    little = ("--edges", "1", "--missions", "2", "--connections", "2", "--seconds", "1", "--writers", "1")
    found = figures(
        "benchmarks.capacity", *little, "--pace", "0", "--flights", "0", "--leases", "5", out=tmp_path / "c.json"
    )
    reported = found["full"]["1"]
    spent = reported["edge_s"] + reported["database_s"] + reported["client_s"]
    assert reported["edge_s"] > reported["database_s"] > 0 and reported["log_bytes"] > 0
    assert reported["predicted_a_s"] == pytest.approx(min(1 / reported["edge_s"], found["cores"] / spent))
    # No more than what is there can have been used.
    assert 0 < reported["decisions_a_s"] * spent == pytest.approx(reported["cores_used"])
    assert found["commits_a_s"]["1"] > 0 and found["renewal"]["leases"] == 5


def test_the_cost_of_a_decision_in_a_mode_that_asks_no_llm(tmp_path: Path) -> None:
    found = modes(tmp_path, Capacity(flights=1), (("value", "on"),))
    (reported,) = found.values()
    assert list(found) == ["value, planner on"] and 0 < reported["edge_s"] < 1 and reported["decisions_a_s"] > 0
