"""lab/benchmarks/llm_missions.py at its smallest: two missions of the real embedded LLM, in real time."""

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_it_counts_the_decisions_of_all_missions(tmp_path: Path) -> None:
    little = ("--missions", "2", "--steps", "2", "--step-s", "0.5")
    found = figures("lab.benchmarks.llm_missions", *little, out=tmp_path / "m.json")
    assert found["decisions"] == 2 * 2 * 3 == sum(found["sources"].values())
    assert found["llm_share"] == pytest.approx(found["sources"].get("llm", 0) / 12, abs=1e-4)
    assert 0 < found["round_trip_s"]["p50"] <= found["round_trip_s_max"]
