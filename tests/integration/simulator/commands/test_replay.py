"""`aicvds replay` with a real edge without an LLM, and with a stub that misbehaves by a script."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared.wire.schemas import DecideRequest, MissionSpec
from simulator.commands import replay, simulate
from simulator.commands.replay import read_logged_mission
from simulator.records.mission_logs import read_decisions, read_requests
from simulator.reporting.replay_agreement import ReplaySummary
from tests.conftest import Edge
from tests.support.edge_stub import EdgeStub, stub_edge
from tests.support.undrawn import reports_undrawn


@pytest.fixture(autouse=True, scope="module")
def undrawn() -> Iterator[None]:
    """No flight here draws its report."""
    with reports_undrawn():
        yield


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


def fly(url: str, out: Path, steps: int = 4, **changes: str) -> Path:
    arguments = [text for name, value in changes.items() for text in (f"--{name}", value)]
    assert simulate.main(["--edge", url, "--steps", str(steps), "--out", str(out), *arguments]) == 0
    return out


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mission of 3 steps, flown once; tests change only copies of it."""
    with stub_edge() as edge:
        return fly(edge.url, tmp_path_factory.mktemp("logged"), 3)


@pytest.fixture
def run(logged: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(logged, tmp_path / "run"))


def replay_again(run: Path, url: str, out: Path, *arguments: str) -> ReplaySummary:
    assert replay.main([str(run), "--edge", url, "--out", str(out), *arguments]) == 0
    return ReplaySummary.model_validate_json((out / "replay.json").read_bytes())


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_mission_logs_its_requests_and_they_can_be_read(stub: EdgeStub, tmp_path: Path) -> None:
    run = fly(stub.url, tmp_path / "run", 3)
    spec, requests = read_requests(run / "requests.jsonl")
    assert requests == stub.decides
    assert [r.outcome is None for r in requests] == [True] * 3 + [False] * 6
    # The log has the edge's defaults, so that another edge's defaults change nothing.
    assert (spec.mode, spec.top_k, spec.scenario) == ("llm", 5, stub.missions[requests[0].mission_id].scenario)
    per_decision = (run / "requests.jsonl").stat().st_size / 9
    assert 700 < per_decision < 1500, "--help says about 1 kB a decision"


@pytest.mark.long
def test_a_local_policys_mission_leaves_no_requests_of_another(run: Path) -> None:
    assert simulate.main(["--policy", "eof", "--steps", "2", "--out", str(run), "--overwrite"]) == 0
    assert not (run / "requests.jsonl").exists()


def test_the_same_edge_decides_the_same_and_gets_every_outcome(
    edge: Edge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The modules learn beside the decisions, so only the policy's decisions are reproducible.
    url = str(edge(mode="llm", llm_gguf="none").base_url)
    run = fly(url, tmp_path / "run", 5, seed="3")
    again = replay_again(run, url, tmp_path / "again")
    assert (again.decisions, again.unasked, again.outcomes_fed_back, again.changed) == (15, 0, 15, {})
    assert again.agreement.both_pct == 100
    assert (again.logged.by_source.policy, again.replayed.by_source.policy) == (15, 15)
    assert again.replayed.prompt_tokens == pytest.approx(again.logged.prompt_tokens)
    printed = capsys.readouterr().out
    assert "15 decisions replayed" in printed and "fed back" not in printed
    replayed = lines(tmp_path / "again" / "replayed.jsonl")
    assert len(replayed) == 15
    assert "cost" in replayed[0]["logged"] and "cost" not in replayed[0]["replayed"]


@pytest.mark.long
def test_another_mode_prompt_and_k_are_compared_and_different_decisions_are_not_fed_back(
    edge: Edge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    client = edge(mode="llm", llm_gguf="none")
    url = str(client.base_url)
    run = fly(url, tmp_path / "run", 8)
    changes = "--mode value --top-k 2 --features reach --init random --experiences 4 --selection failures"
    again = replay_again(run, url, tmp_path / "again", *changes.split())
    assert again.changed == {
        "mode": ("llm", "value"),
        "top_k": (5, 2),
        "features": ("paper", "reach"),
        "init": ("pretrained", "random"),
        "prompt.experiences": (30, 4),
        "prompt.selection": ("recent", "failures"),
    }
    assert next(iter(again.by_source)) == "value"
    assert again.replayed.prompt_tokens != again.logged.prompt_tokens
    replayed = lines(tmp_path / "again" / "replayed.jsonl")
    same = [
        all(line["logged"][name] == line["replayed"][name] for name in ("sensor_id", "velocity")) for line in replayed
    ]
    assert [line["fed_back"] for line in replayed] == same
    assert again.outcomes_fed_back == sum(same) < 24
    assert client.get(f"/missions/{again.mission_id}").json()["feedback"] == sum(same)
    assert f"{24 - sum(same)} decisions were not fed back" in capsys.readouterr().out


@pytest.mark.long
def test_outcomes_go_with_the_uavs_next_request_or_at_the_end(stub: EdgeStub, run: Path, tmp_path: Path) -> None:
    flown = read_decisions(run / "decisions.jsonl")
    summary = replay_again(run, stub.url, tmp_path / "again", "--deadline-ms", "30000")
    assert {r.mission_id for r in stub.decides} == {summary.mission_id}
    assert {r.deadline_ms for r in stub.decides} == {30_000}
    prices = [r.outcome for r in stub.decides[3:]] + stub.feedbacks
    assert [o.cost for o in prices if o is not None] == [d.cost for d in flown]
    assert not {o.decision_id for o in prices if o is not None} & {d.decision_id for d in flown}


def test_a_replay_that_loses_its_edge_is_written_so_far(
    stub: EdgeStub, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub.script, stub.otherwise = ["ok"] * 4, "crash"
    assert replay.main([str(run), "--edge", stub.url, "--out", str(tmp_path / "again")]) == 1
    assert "after 4 decisions" in capsys.readouterr().err
    summary = ReplaySummary.model_validate_json((tmp_path / "again" / "replay.json").read_bytes())
    assert (summary.decisions, summary.unasked) == (4, 5)
    assert len(lines(tmp_path / "again" / "replayed.jsonl")) == 4


def test_a_request_without_a_flown_decision_is_not_replayed(run: Path) -> None:
    text = (run / "decisions.jsonl").read_text().splitlines(keepends=True)
    (run / "decisions.jsonl").write_text("".join(text[:6]) + text[6][:40])
    requests = (run / "requests.jsonl").read_text()
    (run / "requests.jsonl").write_text(requests[:-200])
    assert [(r.step, d.uav_id) for r, d in read_logged_mission(run).decisions] == [
        (s, u) for s in (0, 1) for u in range(3)
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--edge is missing"),
        (["--edge", "nowhere"], "'nowhere' is not an edge's URL"),
        (["--edge", "http://e", "--top-k", "0"], "--top-k 0: "),
        (["--edge", "http://e", "--experiences", "101"], "--experiences 101: "),
        (["--edge", "http://e", "--deadline-ms", "5"], "--deadline-ms 5"),
        (["--edge", "http://e", "--out", __file__], "is a file"),
    ],
)
def test_bad_use_is_one_line_and_code_2(
    arguments: list[str], message: str, logged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay.main([str(logged), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("aicvds replay: ") and error.count("\n") == 1 and message in error


def test_the_error_for_an_unusable_folder_has_the_reason(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(run: Path) -> str:
        assert replay.main([str(run), "--edge", "http://e"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    assert "is no folder" in refused(tmp_path / "none")
    (run / "decisions.jsonl").write_text("")
    assert "no decision to replay" in refused(run)
    (run / "decisions.jsonl").unlink()
    assert "decisions.jsonl: No such file" in refused(run)
    (run / "requests.jsonl").write_text('{"spec": 1}\n\n')
    assert "requests.jsonl, line 1: " in refused(run)
    (run / "requests.jsonl").unlink()
    assert "has no requests.jsonl" in refused(run)


def test_an_earlier_replay_is_overwritten_only_with_the_option(
    stub: EdgeStub, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replay_again(run, stub.url, tmp_path / "again")
    assert replay.main([str(run), "--edge", stub.url, "--out", str(tmp_path / "again")]) == 2
    assert "already has a replay.json" in capsys.readouterr().err
    replay_again(run, stub.url, tmp_path / "again", "--overwrite")


def test_no_edge_is_code_1(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "again"
    assert replay.main([str(run), "--edge", "http://127.0.0.1:1", "--wait-s", "0", "--out", str(out)]) == 1
    assert "http://127.0.0.1:1" in capsys.readouterr().err
    assert not out.exists()


def test_without_prices_at_the_edge_no_cost_is_known(stub: EdgeStub, run: Path, tmp_path: Path) -> None:
    assert replay_again(run, stub.url, tmp_path / "again").replayed.cost_usd is None


def test_help_comes_without_the_heavy_imports() -> None:
    code = (
        "import sys; from simulator.commands import replay; replay.main(['--help']);"
        "print([m for m in ('matplotlib', 'scipy', 'torch') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ})
    assert done.stderr.strip() == "[]"
    assert "runs/other-model" in done.stdout


def test_the_log_is_the_wires_own_types(logged: Path) -> None:
    text = (logged / "requests.jsonl").read_text().splitlines()
    assert MissionSpec.model_validate_json(text[0]).seed == 0
    assert [DecideRequest.model_validate_json(line).step for line in text[1:]] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
