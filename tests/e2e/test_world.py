"""A world of one's own as a user flies it: the worked example, on board and against an edge."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from simulator.records.mission_logs import read_decisions
from tests.conftest import Edge
from tests.support.places import ROOT
from tests.support.processes import run, run_here
from tests.support.undrawn import reports_undrawn

EXAMPLE = ROOT / "examples" / "pipeline_world"


def summary_in(out: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary


def test_the_example_flown_on_board(tmp_path: Path) -> None:
    flown = run("simulate", "--world", str(EXAMPLE), "--policy", "eof", "--no-bound", "--out", str(tmp_path))
    assert (flown.returncode, flown.stderr) == (0, "")
    summary = summary_in(tmp_path)
    assert [summary[key] for key in ("scenario", "steps", "sensors", "uavs")] == ["pipeline_world", 60, 14, 3]
    assert summary["decisions"] == 180
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "pipeline_world" in report and "<svg" in report


def flown_by(edge: httpx.Client, out: Path, *more: str) -> dict[str, Any]:
    """The summary of a mission flown against an edge; its report is not looked at."""
    with reports_undrawn():
        flown = run_here(
            *("simulate", "--world", str(EXAMPLE), "--edge", str(edge.base_url)), "--no-bound", "--out", str(out), *more
        )
    assert flown.returncode == 0, flown.stderr
    return summary_in(out)


def test_the_example_flown_by_the_edges_learned_values(edge: Edge, tmp_path: Path) -> None:
    summary = flown_by(edge(mode="value"), tmp_path, "--steps", "20")
    assert (summary["scenario"], summary["decisions"], summary["by_source"]["onboard"]) == ("pipeline_world", 60, 0)
    assert summary["by_source"]["value"] > 50


def test_the_example_flown_by_the_edges_look_ahead(edge: Edge, tmp_path: Path) -> None:
    """It looks ahead along the routes: fast as it flies, what it chooses is in reach where the UAV then is."""
    summary = flown_by(edge(mode="llm", llm_gguf="none", planner="off"), tmp_path)
    assert summary["by_source"]["policy"] == summary["decisions"] == 180
    decisions = read_decisions(tmp_path / "decisions.jsonl")
    assert np.mean([d.velocity for d in decisions]) > 12
    assert summary["failures"] <= 2
    assert summary["lost_packets"]["aic_vds"] < summary["lost_packets"]["eof"]


@pytest.mark.long
def test_the_example_flown_by_the_edges_planner(edge: Edge, tmp_path: Path) -> None:
    summary = flown_by(edge(mode="policy"), tmp_path, "--steps", "20")
    assert summary["by_source"]["policy"] == summary["decisions"] == 60
    assert summary["failures"] <= 2
    assert summary["lost_packets"]["aic_vds"] < summary["lost_packets"]["eof"]


def test_bad_use_is_one_clear_line(tmp_path: Path) -> None:
    both = run_here("simulate", "--world", str(EXAMPLE), "--scenario", "paper", "--policy", "eof")
    assert both.returncode == 2
    assert both.stderr.strip().endswith("contradict each other; give one of the two")
    assert run_here("demo", "--world", str(EXAMPLE), "--scenario", "paper", "--out", str(tmp_path)).stderr == (
        both.stderr.replace("aicvds simulate", "aicvds demo")
    )
    (tmp_path / "world.geojson").write_text('{"type": "FeatureCollection",\n "features": [}', encoding="utf-8")
    broken = run_here("simulate", "--world", str(tmp_path), "--policy", "eof")
    assert broken.returncode == 2
    assert broken.stderr.count("\n") == 1 and "world.geojson is no JSON" in broken.stderr and "line 2" in broken.stderr


def test_a_longer_mission_than_the_trace_says_so() -> None:
    long = run_here("simulate", "--world", str(EXAMPLE), "--policy", "eof", "--steps", "61")
    assert long.returncode == 2
    assert "arrivals.csv has 60 steps, the mission 61" in long.stderr
