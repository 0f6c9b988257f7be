"""The benchmarks at their smallest: they measure what they say, of real edges, and write it down."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def measured(tmp_path: Path, name: str, *options: str) -> dict[str, Any]:
    out = tmp_path / "found.json"
    command = [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), *options, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def test_sensors_tells_the_share_by_stage_the_memory_and_the_wire(tmp_path: Path) -> None:
    found = measured(tmp_path, "sensors", "--sensors", "5", "40", "--steps", "2", "--rounds", "1")
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


def test_fleet_tells_decisions_a_second_memory_and_what_learning_costs(tmp_path: Path) -> None:
    little = ("--missions", "1", "3", "--decisions", "9", "--each", "6", "--veterans", "1", "--lifetime", "9")
    found = measured(tmp_path, "fleet", *little, "--pace", "50", "--block", "5", "--blocks", "1")
    for rate in found["rates"].values():
        assert rate["decisions_a_s"] > 0
        assert 0 < rate["p50_ms"] <= rate["p99_ms"]
    assert found["learning"]["with_outcomes"]["p99_ms"] > 0 < found["learning"]["without"]["p99_ms"]
    assert found["memory"]["missions"] == 3
    assert found["memory"]["kb_a_mission"] > 0
