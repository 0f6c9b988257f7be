from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.wire.schemas import MissionSpec
from shared.world.scenario import SCENARIOS
from simulator.commands import simulate
from simulator.records.mission_logs import read_decisions
from simulator.records.run_folder import DRAWN
from simulator.records.summary import LossBound, Summary
from tests.support.edge_stub import EdgeStub, free_port, stub_edge
from tests.support.waiting import PATIENCE_S, until


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


def summary_in(out: Path) -> Summary:
    return Summary.model_validate_json((out / "summary.json").read_bytes())


def test_a_mission_leaves_its_files(stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    code = simulate.main(
        ["--edge", stub.url, "--steps", "3", "--seed", "4", "--deadline-ms", "30000", "--out", str(out)]
    )
    assert code == 0
    left = ["decisions.jsonl", "figures", "report.html", "requests.jsonl", "summary.json"]
    assert sorted(p.name for p in out.iterdir()) == left
    assert {str(p.relative_to(out)) for p in (out / "figures").iterdir()} == set(DRAWN)
    summary = summary_in(out)
    assert (summary.seed, summary.steps, summary.decisions, summary.deadline_ms) == (4, 3, 9, 30_000)
    assert len(read_decisions(out / "decisions.jsonl")) == 9
    assert summary.command.startswith("aicvds simulate --edge http://127.0.0.1")
    assert set(stub.missions) == {summary.mission_id}
    assert stub.missions[summary.mission_id].seed == 4
    assert {d.deadline_ms for d in stub.decides} == {30_000}
    printed = capsys.readouterr().out
    assert "AIC-VDS: 6 llm, 3 policy" in printed
    assert "The LLM took 6 of 9 decisions" in printed and "llm_timeout 3" in printed
    assert "80 % read from" in printed and "lost; 6 llm, 3 policy" in printed
    for words in ("AIC-VDS", "EOF", "WQCS", "summary.json", "report.html"):
        assert words in printed


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("awaited", "polled", "message"), [("on", 3, "stub-1"), ("off", 1, "unavailable")])
def test_an_llm_out_of_reach_is_waited_for_where_that_is_wanted(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str], awaited: str, polled: int, message: str
) -> None:
    stub.readiness = [(True, "unavailable"), (True, "unavailable"), (True, "ready")]
    arguments = ["--edge", stub.url, "--steps", "1", "--await-llm", awaited, "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    assert stub.polled == polled
    assert message in capsys.readouterr().out


@pytest.mark.long
def test_an_old_result_is_overwritten_only_with_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--policy", "eof", "--steps", "2", "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    assert simulate.main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err
    (tmp_path / "figures" / "tokens.pdf").write_text("of a mission that an LLM flew")
    assert simulate.main([*arguments, "--overwrite"]) == 0
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"losses", "visits"}


@pytest.mark.usefixtures("undrawn")
def test_a_local_policy_is_reported_under_its_own_name(tmp_path: Path) -> None:
    assert simulate.main(["--policy", "round_robin", "--steps", "2", "--out", str(tmp_path)]) == 0
    summary = summary_in(tmp_path)
    assert set(summary.lost_packets) == {"round_robin", "eof", "wqcs"}
    assert summary.edge is None and summary.by_source.onboard == 6


OWN_POLICY = """
from own_part import VELOCITY

class Fullest:
    def reset(self, scenario, seed):
        pass

    def decide(self, uav, observation, taken):
        return int(observation["queue"].argmax()), VELOCITY
"""


@pytest.mark.usefixtures("undrawn")
def test_an_own_policy_flies_beside_modes_of_an_edge_started_for_it(tmp_path: Path) -> None:
    (tmp_path / "own_part.py").write_text("VELOCITY = 3", "utf-8")
    (tmp_path / "random.py").write_text(OWN_POLICY, "utf-8")
    policy, out = f"{tmp_path}/random.py:Fullest", tmp_path / "run"
    arguments = ["--against", "edge:value", "--against", "round_robin", "--sensors", "6", "--uavs", "2"]
    assert simulate.main(["--policy", policy, *arguments, "--no-bound", "--steps", "2", "--out", str(out)]) == 0
    summary = summary_in(out)
    assert set(summary.lost_packets) == {policy, "eof", "wqcs", "edge:value", "round_robin"}
    assert (summary.scenario[:14], summary.decisions, summary.edge) == ("paper_changed_", 4, None)
    assert {decision.velocity for decision in read_decisions(out / "decisions.jsonl")} == {3}
    assert (out / "edge.log").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_mode_of_a_running_edge_flies_for_comparison(stub: EdgeStub, tmp_path: Path) -> None:
    arguments = ["--edge", stub.url, "--against", "edge:policy", "--steps", "1", "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    summary = summary_in(tmp_path)
    assert set(summary.lost_packets) == {"aic_vds", "eof", "wqcs", "edge:policy"}
    assert {spec.mode for spec in stub.missions.values()} == {None, "policy"}


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_ends_all_comparisons_and_keeps_the_flight(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub.script, stub.otherwise = ["ok"] * 3, "slow"

    def interrupt() -> None:
        until(lambda: stub.at_once)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    pressed = threading.Thread(target=interrupt)
    pressed.start()
    arguments = ["--edge", stub.url, "--against", "edge:policy", "--against", "edge:value", "--steps", "1"]
    assert simulate.main([*arguments, "--out", str(tmp_path)]) == 0
    pressed.join()
    stub.gate.open()
    assert "edge:policy was not flown to its end: interrupted" in capsys.readouterr().err
    assert set(summary_in(tmp_path).lost_packets) == {"aic_vds", "eof", "wqcs"}
    assert {spec.mode for spec in stub.missions.values()} == {None, "policy"}


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_that_the_edge_did_not_decide_is_left_out_with_its_cause(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub.script, stub.otherwise = ["ok"] * 3, "invalid"
    arguments = ["--edge", stub.url, "--against", "edge:policy", "--steps", "1", "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    assert "edge:policy was not flown: 3 decisions were taken on board" in capsys.readouterr().err
    assert set(summary_in(tmp_path).lost_packets) == {"aic_vds", "eof", "wqcs"}


@pytest.mark.usefixtures("undrawn")
def test_a_paced_flight_takes_the_worlds_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    arguments = ["--policy", "eof", "--no-bound", "--steps", "3", "--pace", "0.01x", "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    # A step of 10 s lasts 1,000 s, less what the flight itself took.
    assert [round(pause, -3) for pause in slept if pause > 100] == [1000, 2000, 3000]


def test_the_bound_is_searched_unless_it_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = LossBound(lower_bound=2, best_flight=2, seconds=0.5)
    monkeypatch.setattr("simulator.bound.clairvoyant_bound.mission_bound", lambda *_: found)
    arguments = ["--policy", "eof", "--steps", "2", "--out", str(tmp_path)]
    assert simulate.main(arguments) == 0
    assert summary_in(tmp_path).bound == found
    assert "Nobody can lose fewer than 2 packets" in capsys.readouterr().out
    assert "Nobody can lose fewer than 2 packets" in (tmp_path / "report.html").read_text("utf-8")
    assert simulate.main([*arguments, "--overwrite", "--no-bound"]) == 0
    assert (summary_in(tmp_path).bound, summary_in(tmp_path).bound_missing) == (None, None)


@pytest.mark.usefixtures("undrawn")
def test_a_named_mission_has_its_note_and_its_address(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--edge", stub.url, "--steps", "1", "--mission", "patrol", "--out", str(tmp_path), "--overwrite"]
    assert simulate.main([*arguments, "--note", "Visit sensor 4 every third step."]) == 0
    assert stub.missions["patrol"].note == "Visit sensor 4 every third step."
    assert f"Mission patrol; watch it at {stub.url}/?mission=patrol" in capsys.readouterr().out
    # The mission is there: it is flown as it is, and a new note is given to it.
    made = stub.missions["patrol"]
    assert simulate.main([*arguments, "--note", "Visit sensor 2 every fourth step."]) == 0
    assert stub.missions["patrol"] is made and stub.notes == {"patrol": "Visit sensor 2 every fourth step."}


@pytest.mark.usefixtures("undrawn")
def test_a_flight_may_end_before_its_mission_does(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub.missions["patrol"] = MissionSpec(scenario=SCENARIOS["paper"])
    arguments = ["--edge", stub.url, "--mission", "patrol", "--steps", "1", "--out", str(tmp_path), "--overwrite"]
    assert simulate.main(arguments) == 0
    assert "seed 0, 1 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "flown", "message"),
    [
        (["--steps", "4"], 0, "of 3 steps; give at most --steps 3"),
        (["--scenario", "stress", "--steps", "3"], 0, "for another world (paper)"),
        (["--steps", "1", "--mode", "value"], 0, "in mode llm; leave out --mode value"),
        (["--steps", "1"], 3, "with 3 decisions already; choose another ID"),
    ],
)
def test_a_mission_that_does_not_fit_is_refused(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], flown: int, message: str
) -> None:
    stub.missions["patrol"] = MissionSpec(scenario=SCENARIOS["paper"].model_copy(update={"steps": 3}))
    stub.flown["patrol"] = flown
    assert simulate.main(["--edge", stub.url, "--mission", "patrol", "--out", str(tmp_path), *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--edge is missing"),
        (["--edge", "nowhere"], "'nowhere' is not an edge's URL"),
        (["--edge", "http://e", "--scenario", "mars"], "unknown scenario 'mars'"),
        (["--edge", "http://e", "--steps", "0"], "--steps 0"),
        (["--edge", "http://e", "--seed", "-1"], "--seed -1"),
        (["--edge", "http://e", "--policy", "magic"], "--policy magic"),
        (["--edge", "http://e", "--deadline-ms", "5"], "--deadline-ms 5"),
        (["--edge", "http://e", "--wait-s", "nan"], "--wait-s nan"),
        (["--edge", "http://e", "--reconnect-s", "-1"], "--reconnect-s -1"),
        (["--edge", "http://e", "--policy", "eof"], "--policy eof asks no edge"),
        (["--policy", "eof", "--uplink", "delta"], "--uplink delta means nothing"),
        (["--policy", "edge:magic"], "--policy edge:magic: choose one of edge:llm, edge:guided, edge:value"),
        (["--policy", "edge:llm", "--mode", "value"], "--policy edge:llm and --mode value contradict"),
        (["--policy", "edge:value", "--edge", "nowhere"], "'nowhere' is not an edge's URL"),
        (["--policy", "eof", "--against", "edge:value", "--edge", "nowhere"], "'nowhere' is not an edge's URL"),
        (["--policy", "eof", "--against", "edge"], "--against edge: say in which mode"),
        (["--policy", "eof", "--against", "magic"], "--against magic: choose one of"),
        (["--policy", "eof", "--against", "none.py:Mine"], "policy none.py:Mine: there is no file none.py"),
        (["--policy", f"{__file__}:Mine"], f"{__file__} has no Mine"),
        (["--policy", "eof", "--pace", "0x"], "--pace 0x: write real, or how many times faster"),
        (["--policy", "eof", "--pace", "fast"], "--pace fast: write real"),
        (["--policy", "eof", "--sensors", "0"], "--sensors 0: must be greater"),
        (["--policy", "eof", "--mode", "llm"], "--mode llm means nothing"),
        (["--policy", "eof", "--note", "x"], "--note x means nothing"),
        (["--edge", "http://e", "--mission", "a b"], "--mission 'a b'"),
        (["--edge", "http://e", "--note", "x" * 281], "at most 280"),
        (["--edge", "http://e", "--out", __file__], "is a file"),
        (["--policy", "eof", "--out", f"{__file__}/below"], f"--out {__file__}/below: Not a directory"),
    ],
)
def test_bad_use_is_one_line_and_code_2(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("aicvds simulate: ") and error.count("\n") == 1 and message in error


def test_an_error_of_tyro_is_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate.main(["--seed", "x"]) == 2
    assert simulate.main(["--help"]) == 0
    assert "AICVDS_API_KEY" in capsys.readouterr().out


def test_no_edge_is_code_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert simulate.main(["--edge", "http://127.0.0.1:1", "--wait-s", "0", "--out", str(out)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "http://127.0.0.1:1" in error
    assert not out.exists()


@pytest.mark.usefixtures("undrawn")
def test_an_edge_that_never_decides_is_code_1(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub.otherwise = "crash"
    assert simulate.main(["--edge", stub.url, "--steps", "2", "--out", str(tmp_path)]) == 1
    assert "6 decisions were taken on board" in capsys.readouterr().err
    assert summary_in(tmp_path).by_reason == {"edge_refused": 6}


@pytest.mark.usefixtures("undrawn")
def test_an_edge_that_refuses_the_last_outcomes_is_named(
    stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every decision was the edge's, so none is said to be taken on board."""
    stub.script, stub.otherwise = ["ok"] * 6, "crash"
    assert simulate.main(["--edge", stub.url, "--steps", "2", "--out", str(tmp_path)]) == 0
    error = capsys.readouterr().err
    assert "The edge's last failure: " in error and "/feedback" in error and "on board" not in error


@pytest.mark.long
def test_sigterm_leaves_a_partial_result(stub: EdgeStub, tmp_path: Path) -> None:
    # It is interrupted while the eighth decision is waited for: the second of the third step.
    stub.script, stub.otherwise = ["ok"] * 7, "slow"
    arguments = ["simulate", "--edge", stub.url, "--no-bound", "--out", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, "-m", "shared.kit.command_line", *arguments], stdout=subprocess.PIPE, text=True
    )
    try:
        until(lambda: stub.gate.callers)
        process.send_signal(signal.SIGTERM)
        printed, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130
    finally:
        process.kill()
        process.wait()
    summary = summary_in(tmp_path)
    assert f"interrupted after {summary.steps_flown} steps; writing their results" in printed
    assert summary.interrupted and summary.steps_flown == 2
    assert summary.decisions == 3 * summary.steps_flown == len(read_decisions(tmp_path / "decisions.jsonl"))
    assert f"interrupted after step {summary.steps_flown} of 30" in (tmp_path / "report.html").read_text("utf-8")


def test_help_comes_without_the_heavy_imports() -> None:
    code = (
        "import sys; from simulator.commands import simulate; simulate.main(['--help']);"
        "print([m for m in ('matplotlib', 'scipy', 'torch') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.usefixtures("undrawn")
def test_a_flight_is_written_though_what_it_is_compared_with_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "half.py").write_text(OWN_POLICY.replace(", VELOCITY", ", VELOCITY + 0.5"), "utf-8")
    (tmp_path / "own_part.py").write_text("VELOCITY = 3", "utf-8")
    failing, out = f"{tmp_path}/half.py:Fullest", tmp_path / "run"
    arguments = ["--against", failing, "--against", "edge:policy", "--against", "round_robin", "--wait-s", "0"]
    arguments += ["--edge", f"http://127.0.0.1:{free_port()}", "--no-bound", "--steps", "2", "--out", str(out)]
    assert simulate.main(["--policy", "eof", *arguments]) == 0
    assert set(summary_in(out).lost_packets) == {"eof", "wqcs", "round_robin"}
    printed = capsys.readouterr().err
    assert f"{failing} was not flown: UAV 0, step 0" in printed and "edge:policy was not flown: no edge" in printed


BAD_POLICY = """
class Fullest:
    def reset(self, scenario, seed):
        pass

    def decide(self, uav, observation, taken):
        raise IndexError
"""


@pytest.mark.usefixtures("undrawn")
def test_a_policy_that_raises_costs_no_flight_and_a_killed_flights_log_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.py").write_text(BAD_POLICY, "utf-8")
    flight = ["--policy", "eof", "--no-bound", "--steps", "2", "--out", str(tmp_path / "run")]
    assert simulate.main([*flight, "--against", f"{tmp_path}/bad.py:Fullest"]) == 0
    assert "bad.py:Fullest was not flown: IndexError" in capsys.readouterr().err
    assert set(summary_in(tmp_path / "run").lost_packets) == {"eof", "wqcs"}
    (tmp_path / "run" / "summary.json").unlink()
    assert simulate.main(flight) == 2
    assert "already has a decisions.jsonl" in capsys.readouterr().err
