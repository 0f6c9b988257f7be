"""The quicker benchmarks at their smallest: each measures what it says, of real processes, and writes it down."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


@pytest.mark.timeout(600)
def test_startup_starts_everything(tmp_path: Path) -> None:
    found = figures("benchmarks.startup", "--rounds", "1", out=tmp_path / "startup.json")
    took = found["median_s"]
    assert {"import numba, fastapi", "serve: /healthz", "--help", "serve --help"} <= set(took)
    assert 0 < took["serve: /healthz"] < took["serve: /decide"]
    ratio = took["serve: /healthz"] / took["import numba, fastapi"]
    assert found["healthz_to_imports"]["ratio"] == pytest.approx(ratio, rel=0.05)


def test_overhead_compares_the_edge_with_a_forwarder(tmp_path: Path) -> None:
    little = ("--rounds", "1", "--seconds", "0.3", "--uavs", "3", "--litellm", "none")
    found = figures("benchmarks.overhead", *little, out=tmp_path / "overhead.json")
    rows = {row["service"]: row for row in found["rows"]}
    assert list(rows) == ["direct", "bare", "edge", "edge, no outcomes", "edge, no store"]
    assert rows["direct"]["p50"] < rows["edge"]["p50"] and rows["edge"]["cpu"] > 0
    assert len(rows["edge"]["to bare"]["p50"]) == 3 and len(found["goals"]) == 9


def test_processor_stages_add_up(tmp_path: Path) -> None:
    found = figures("benchmarks.processor_stages", "--rounds", "1", "--seconds", "1", out=tmp_path / "stages.json")
    (only,) = found["rounds"]
    assert only["samples"] > 0 and found["stages"]["report and belief"][0] > 0
    whole = sum(spent for stage, spent in only.items() if stage != "samples")
    assert found["goals"][0]["value"] == pytest.approx(whole, abs=0.02)


def test_world_steps_a_batch_and_single_worlds(tmp_path: Path) -> None:
    found = figures("benchmarks.world", "--worlds", "16", "--rounds", "1", out=tmp_path / "world.json")
    for scenario in ("paper", "field"):
        assert (
            found["scenarios"][scenario]["batch_steps_per_s"] > 0 < found["scenarios"][scenario]["single_steps_per_s"]
        )
    assert [goal["least"] for goal in found["goals"]] == [300_000, 5_000, 20_000]


@pytest.mark.needs("chromium")
def test_page_counts_frames_and_updates(tmp_path: Path) -> None:
    little = ("--seconds", "2", "--sensors", "4", "--uavs", "1")
    idle, flown = figures("benchmarks.page", *little, out=tmp_path / "page.json")["frames"].values()
    assert idle["updates a second"] == 0 < flown["updates a second"]
    assert 0 < flown["p50 ms"] <= flown["most ms"]


def test_soak_counts_decisions_and_resources(tmp_path: Path) -> None:
    little = ("--minutes", "0.2", "--pace-s", "0", "--guided", "0", "--missions", "4", "--warm", "9", "3")
    counted = ("--hostile", "2", "--counted-s", "2")
    out = tmp_path / "soak.json"
    found = figures("benchmarks.soak", *little, *counted, out=out, codes=(0, 1))
    assert found["missions"] == 4 and found["decisions"] > 0
    assert min(found["resident_mb"]) > 50 and min(found["files"]) > 0
    assert found["hostile_connections_ended"]["vanishing"] > 0
    assert found["late"] == found["lost"] == found["unstored"] == 0
    assert len(found["goals"]) == 7
