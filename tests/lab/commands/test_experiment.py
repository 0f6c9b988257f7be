"""``python -m lab experiment`` as a user starts it: real processes, real edges, kills and interrupts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from lab.commands.experiment import ExperimentOptions, setup_of
from lab.experiments.catalogue import EXPERIMENTS
from lab.experiments.result import Result
from lab.experiments.stand_ins import answering, drawn
from tests.support.places import ROOT
from tests.support.processes import LAB, run_lab, run_lab_here, serving_edge
from tests.support.waiting import PATIENCE_S, until


def result_in(out: Path, name: str) -> Result:
    return Result.model_validate_json((out / name / "results.json").read_bytes())


def flights_in(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (out / "flights").glob("*.json.gz")}


def started(out: Path, *args: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*LAB, "experiment", *args, "--out", str(out)], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def until_flights(out: Path, process: subprocess.Popen[bytes], count: int) -> dict[str, int]:
    until(lambda: len(flights_in(out)) >= count or process.poll() is not None)
    assert process.poll() is None, f"it ended with {process.poll()} before there were {count} flights"
    return flights_in(out)


def edge_of(process: subprocess.Popen[bytes]) -> int:
    """Process id of the edge that a run has started."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    [edge] = [int(child) for child in children if b"serve" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return edge


def test_changes_of_a_scenario_are_flown_instead_of_the_experiments_own_worlds() -> None:
    options = ExperimentOptions(name="scenarios", scenario="stress", uavs=2, set=("link_share=0.5",))
    [scenario] = [site.scenario for site in setup_of(options).sites.values()]
    assert (scenario.name[:15], scenario.uavs, scenario.link_share) == ("stress_changed_", 2, 0.5)
    [name] = setup_of(ExperimentOptions(name="scenarios", sensors=20)).sites
    assert name.startswith("paper_changed_")


def test_help_tells_what_every_experiment_is() -> None:
    shown = run_lab_here("experiment", "--help")
    assert shown.returncode == 0
    for name, experiment in EXPERIMENTS.items():
        assert f"{name}: {experiment.summary}" in shown.stdout.replace("\n", " ")


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["nonsense"], "there is no experiment 'nonsense': choose one of scheduler, guided, attention"),
        (["aoi", "--seeds", "0"], "--seeds 0"),
        (["aoi", "--steps", "0"], "--steps 0"),
        (["aoi", "--llm", "gpt"], "--llm gpt"),
        (["aoi", "--edge", "nowhere"], "--edge"),
        (["aoi", "--scenario", "mars"], "--scenario"),
        (["llm-models", "--model", "/no/such.gguf"], "--model /no/such.gguf"),
        (["scheduler", "--policy", "eof"], "write MODULE:CLASS or FILE.py:CLASS; --scheme names a shipped one"),
        (["scheduler", "--policy", "no_such.py:Mine"], "there is no file no_such.py"),
        (["aoi", "--scheme", "eoff"], "not 'eoff'; did you mean eof?"),
        (["top-k", "--llm", "none"], "top-k: every scheme of it asks an LLM"),
    ],
)
def test_bad_use_is_one_line_and_code_2(args: list[str], said: str, tmp_path: Path) -> None:
    ended = run_lab_here("experiment", *args, "--out", str(tmp_path / "out"))
    assert ended.returncode == 2
    assert said in ended.stderr and ended.stderr.count("\n") == 1


def test_without_the_extra_ray_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    args = ["fairness", "--llm", "none", "--seeds", "1", "--steps", "1", "--ray", "local", "--out", str(tmp_path)]
    ended = run_lab_here("experiment", *args)
    assert ended.returncode == 2
    assert "pip install 'aic-vds[ray]'" in ended.stderr and ended.stderr.count("\n") == 1


@pytest.mark.long
def test_a_killed_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    args = ["fairness", "--llm", "none", "--steps", "2", "--seeds", "6"]
    process = started(tmp_path, *args)
    try:
        before = until_flights(tmp_path, process, 5)
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)
    assert not (tmp_path / "fairness").exists()
    ended = run_lab("experiment", *args, "--out", str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    after = flights_in(tmp_path)
    assert before.items() <= after.items(), "a flight was flown twice"
    result = result_in(tmp_path, "fairness")
    assert len(after) == 6 * len(result.schemes) and result.seeds == list(range(6))
    assert {path.suffix for path in (tmp_path / "fairness").iterdir()} >= {".json", ".csv", ".png", ".svg"}


@pytest.mark.long
def test_an_interrupt_keeps_what_was_flown_and_leaves_no_edge(tmp_path: Path) -> None:
    process = started(tmp_path, "attention", "--llm", "none", "--seeds", "200")
    try:
        until_flights(tmp_path, process, 2)
        edge = edge_of(process)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 130
    assert len(flights_in(tmp_path)) >= 2
    assert not Path(f"/proc/{edge}").exists()


@pytest.mark.long
def test_an_edge_that_dies_is_told_with_its_log(tmp_path: Path) -> None:
    process = started(tmp_path, "attention", "--llm", "none", "--seeds", "200")
    try:
        until_flights(tmp_path, process, 1)
        os.kill(edge_of(process), signal.SIGKILL)
        _, reported = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 1
    error = reported.decode()
    assert "the edge ended with code -9" in error and "edge-off.log" in error and "Traceback" not in error


@pytest.mark.long
def test_an_edge_without_a_usable_llm_is_refused(tmp_path: Path) -> None:
    args = ["top-k", "--llm", "http://127.0.0.1:1/v1", "--steps", "2", "--seeds", "1"]
    ended = run_lab("experiment", *args, "--out", str(tmp_path))
    assert ended.returncode == 1
    assert "no LLM is ready (it is unavailable)" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not flights_in(tmp_path)


@pytest.mark.long
def test_a_running_edge_can_be_asked_instead(tmp_path: Path) -> None:
    with answering(drawn) as llm, serving_edge(AICVDS_LLM_URL=llm) as (url, _):
        ended = run_lab("experiment", "top-k", "--edge", url, "--steps", "2", "--seeds", "1", "--out", str(tmp_path))
        assert "aicvds_decisions_total" in httpx.get(f"{url}/metrics").text
    assert ended.returncode == 0, ended.stderr
    result = result_in(tmp_path, "top-k")
    assert result.model == "uniform draws"
    assert result.sweep is not None and result.sweep.at == {f"k{k}": k for k in (1, 2, 3, 5, 7, 10)}
    assert result.schemes["k1"]["state_tokens"].mean < result.schemes["k10"]["state_tokens"].mean


def test_the_page_is_a_command_of_its_own() -> None:
    shown = run_lab_here("experiment", "page", "--help")
    assert shown.returncode == 0 and "python -m lab experiment page" in shown.stdout


def test_help_comes_without_the_heavy_imports() -> None:
    code = (
        "import sys; from lab.commands import experiment; experiment.main(['--help']);"
        "print([m for m in ('matplotlib', 'ray', 'scipy', 'torch') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.long
def test_the_embedded_llm_decides_and_draws_at_random_stand_beside_it(tmp_path: Path) -> None:
    ended = run_lab("experiment", "llm-models", "--steps", "1", "--seeds", "1", "--out", str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    result = result_in(tmp_path, "llm-models")
    assert list(result.schemes) == [
        "llm",
        "llm_chance",
        "guided",
        "value_reach",
        "edge_policy",
        "eof",
        "random",
    ]
    for asked in ("llm", "llm_chance"):
        assert result.schemes[asked]["llm_decided_pct"].mean > 60
    for unasked in ("value_reach", "edge_policy"):
        assert result.schemes[unasked]["llm_decided_pct"].mean == 0
    assert result.model == "SmolLM2-135M-Instruct.Q8_0"
    assert not any("not the LLM's" in note for note in result.notes)
    assert json.loads((tmp_path / "llm-models" / "results.json").read_text())["command"] == (
        "python -m lab experiment llm-models --steps 1 --seeds 1"
    )
