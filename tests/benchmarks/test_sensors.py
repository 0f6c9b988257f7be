"""benchmarks/sensors.py at its smallest: it measures what it says, of real edges, and writes it down."""

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_it_tells_the_share_by_stage_the_memory_and_the_wire(tmp_path: Path) -> None:
    smallest = ("--sensors", "5", "40", "--steps", "2", "--rounds", "1")
    found = figures("benchmarks.sensors", *smallest, out=tmp_path / "sensors.json")
    for mode in ("value", "llm"):
        assert found["share_ratio"][mode]["5"] == 1
        p50 = found["took_ms"][mode]["40"]["p50"]
        assert 0 < p50["share"] < p50["round_trip"]
        assert {"augment", "attend", "prompt", "check", "store"} < set(p50)
    assert set(found["peak_memory_growth_mb"]) == {"5", "40"}
    wire = found["wire"]["40"]
    assert wire["full"]["sensors"] == 40 > wire["pruned"]["sensors"]
    assert wire["full"]["plain"]["bytes"] > wire["full"]["gzip"]["bytes"] > wire["pruned"]["plain"]["bytes"] > 0
    assert wire["full"]["plain"]["bytes"] > wire["delta"]["plain"]["bytes"]
