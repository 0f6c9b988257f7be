"""A short mission as a user flies it: two processes, HTTP between them, the real embedded LLM."""

import json
from pathlib import Path

from simulator.record import read_decisions
from tests.e2e.processes import run, serving_edge


def test_a_mission_flown_by_the_llm(tmp_path: Path) -> None:
    # The deadline is generous because this tests what is decided, not how fast the machine is.
    with serving_edge(AICVDS_DEADLINE_MS="30000") as (url, _):
        flown = run("simulate", "--edge", url, "--steps", "6", "--seed", "2", "--out", str(tmp_path / "out"))
    assert flown.returncode == 0, flown.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["decisions"], summary["late"]) == (18, 0)
    assert summary["by_source"]["llm"] > 9
    assert summary["by_source"]["onboard"] == 0
    assert set(summary["by_reason"]) <= {"no_candidate"}
    assert set(summary["lost_packets"]) == {"aic_vds", "eof", "wqcs"}
    assert summary["tokens"]["state_mean"] <= 0.5 * summary["tokens"]["state_uncompressed_mean"]
    decisions = read_decisions(tmp_path / "out" / "decisions.jsonl")
    for step in range(6):
        given = [d.sensor_id for d in decisions if d.step == step]
        assert len(set(given)) == 3, "no sensor is given to two UAVs of one step"
    assert "<svg" in (tmp_path / "out" / "report.html").read_text()
