"""A short mission as a user flies it: two processes, HTTP between them, the real embedded LLM."""

import json
from pathlib import Path

import pytest

from simulator.records.mission_logs import read_decisions
from tests.support.processes import run, serving_edge

pytestmark = pytest.mark.long


def test_a_mission_flown_by_the_llm_and_asked_again(tmp_path: Path) -> None:
    # The deadline is generous because this tests what is decided, not how fast the machine is.
    with serving_edge(AICVDS_MODE="llm", AICVDS_LLM_ADAPTER="off", AICVDS_DEADLINE_MS="30000") as (url, _):
        flown = run(
            "simulate", "--edge", url, "--steps", "4", "--seed", "2", "--no-bound", "--out", str(tmp_path / "out")
        )
        options = ("--top-k", "3", "--experiences", "4", "--selection", "failures", "--out", str(tmp_path / "again"))
        again = run("replay", str(tmp_path / "out"), "--edge", url, *options)
    assert flown.returncode == 0, flown.stderr
    assert again.returncode == 0, again.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["decisions"], summary["late"]) == (12, 0)
    assert summary["by_source"]["llm"] > 6
    assert summary["by_source"]["onboard"] == 0
    # The embedded model names sensors out of reach now and then: the verifier overrides it.
    assert set(summary["by_reason"]) <= {"no_candidate", "rule_reach"}
    assert set(summary["lost_packets"]) == {"aic_vds", "eof", "wqcs"}
    assert summary["tokens"]["state_mean"] <= 0.5 * summary["tokens"]["state_uncompressed_mean"]
    decisions = read_decisions(tmp_path / "out" / "decisions.jsonl")
    for step in range(4):
        given = [d.sensor_id for d in decisions if d.step == step]
        assert len(set(given)) == 3, "no sensor is given to two UAVs of one step"
    assert "<svg" in (tmp_path / "out" / "report.html").read_text()

    replay = json.loads((tmp_path / "again" / "replay.json").read_text())
    assert (replay["decisions"], replay["unasked"]) == (12, 0)
    assert set(replay["changed"]) == {"top_k", "prompt.experiences", "prompt.selection"}
    # Other answers may be out of reach.
    assert replay["replayed"]["by_source"]["llm"] > 6
    assert replay["replayed"]["llm_new_tokens"] < 0.5 * replay["replayed"]["llm_prompt_tokens"]
    assert replay["replayed"]["cost_usd"] == 0


def test_the_llm_with_its_adapter_decides_better_than_eof(tmp_path: Path) -> None:
    settings = {"AICVDS_MODE": "llm", "AICVDS_VERIFY": "off", "AICVDS_DEADLINE_MS": "30000"}
    with serving_edge(**settings) as (url, _):
        options = ("--scenario", "paper", "--seed", "1", "--no-bound", "--out", str(tmp_path))
        flown = run("simulate", "--edge", url, *options)
    assert flown.returncode == 0, flown.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["by_source"]["llm"] == summary["decisions"] == 90
    assert summary["model"].endswith("+adapter")
    assert summary["lost_packets"]["aic_vds"] < summary["lost_packets"]["eof"]
