"""benchmarks/llm.py at its smallest: a round with one thread, of the real embedded model."""

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


@pytest.mark.timeout(600)
def test_a_round_of_every_condition(tmp_path: Path) -> None:
    options = ("--rounds", "1", "--threads", "1", "--steps", "2", "--policy", "eof", "--limit-s", "120")
    found = figures("benchmarks.llm", *options, out=tmp_path / "llm.json")
    times = found["times"]
    for way in ("guided", "llm"):
        cold, cached = times[f"{way} cold 1 quiet"], times[f"{way} cached 1 quiet"]
        # Cold reads the whole prompt, and the same one.
        assert times[f"{way} first"]["new_mean"] > 200
        assert cold["new_mean"] > 200 > cached["new_mean"] > 0
        assert f"{way}, 1 threads: busy / quiet" in found["ratios"]
    # One forward pass, against a sensor, a blank and a velocity.
    assert times["guided cached 1 busy"]["written_mean"] == 1.0
    assert times["llm cached 1 busy"]["written_mean"] >= 3.0
    fleet = found["fleet"]
    assert len(fleet) == 4
    # Every slot reads all new experiences; one slot reads them once.
    assert fleet["at once, a slot each"]["new_mean"] > fleet["one after the other"]["new_mean"]
