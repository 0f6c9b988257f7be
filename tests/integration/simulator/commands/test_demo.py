"""`aicvds demo`: its edge is started, used for a flight, and stopped."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from shared.wire.schemas import Mode
from shared.world.scenario import Scenario
from simulator.commands import demo
from simulator.flying.job import Job
from simulator.flying.run import run_mission
from simulator.records.summary import Summary
from simulator.sites.site import Site
from tests.support.edge_stub import EdgeStub, stub_edge
from tests.support.waiting import PATIENCE_S, until


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


def summary_in(out: Path) -> Summary:
    return Summary.model_validate_json((out / "summary.json").read_bytes())


@pytest.mark.long
def test_the_demo_serves_flies_and_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AICVDS_MODE", "value")
    (tmp_path / "summary.json").write_text("{}", encoding="utf-8")
    assert demo.main(["--out", str(tmp_path), "--seed", "1"]) == 0
    summary = summary_in(tmp_path)
    assert summary.decisions == 90 and summary.mode == "value"
    assert summary.by_source.value > 80 and summary.by_source.value + summary.by_source.policy == 90
    assert "Finished server process" in (tmp_path / "edge.log").read_text("utf-8")
    printed = capsys.readouterr().out
    assert f"Open {tmp_path / 'report.html'} in a browser" in printed
    assert f"aicvds compare {tmp_path} runs/next" in printed
    assert summary.edge is not None
    port = int(summary.edge.rsplit(":", 1)[1])
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def flown_beside(stub: EdgeStub, out: Path, mode: Mode) -> Summary:
    """A mission in this mode at the stub, with the reference mode of the demo."""
    site = Site(Scenario(steps=3))
    job = Job(site, 1, "paper-1-x", out, "aicvds demo", edge=stub.url, mode=mode, bound_s=0.0, reference="policy")
    assert run_mission(job, Console()) == 0
    return summary_in(out)


@pytest.mark.usefixtures("undrawn")
def test_the_same_world_is_flown_without_the_llm_too(stub: EdgeStub, tmp_path: Path) -> None:
    summary = flown_beside(stub, tmp_path, "guided")
    assert {name: spec.mode for name, spec in stub.missions.items()} == {
        "paper-1-x": "guided",
        "paper-1-x-policy": "policy",
    }
    # The stub decides alike in every mode.
    assert summary.without_llm == summary.lost_packets["aic_vds"]
    assert summary.decisions == 9 and len(stub.decides) == 18


@pytest.mark.usefixtures("undrawn")
def test_a_mission_without_an_llm_is_flown_once(stub: EdgeStub, tmp_path: Path) -> None:
    assert flown_beside(stub, tmp_path, "value").without_llm is None
    assert list(stub.missions) == ["paper-1-x"]


def test_an_edge_that_dies_at_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AICVDS_MODE", "nonsense")
    assert demo.main(["--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "the edge ended with code 2" in error and "AICVDS_MODE" in error


def test_a_taken_port_is_bad_use(stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = stub.url.rsplit(":", 1)[1]
    assert demo.main(["--out", str(tmp_path), "--port", port]) == 2
    assert f"--port {port}" in capsys.readouterr().err
    assert demo.main(["--out", str(tmp_path), "--port", "65536"]) == 2


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_the_demo_stops_its_edge_when_interrupted(number: signal.Signals, tmp_path: Path) -> None:
    environment = {**os.environ, "AICVDS_MODE": "value"}
    arguments = ["demo", "--out", str(tmp_path), "--scenario", "dense"]
    # Under nohup the tests' own process ignores SIGHUP.
    command = ["env", "--default-signal=HUP", sys.executable, "-m", "shared.kit.command_line", *arguments]
    terminal, its_end = pty.openpty()
    os.set_blocking(terminal, False)
    shown = its_end if number == signal.SIGHUP else subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=shown, stderr=shown, env=environment)
    os.close(its_end)
    log = tmp_path / "decisions.jsonl"

    def decided() -> bool:
        with suppress(OSError):
            os.read(terminal, 65_536)
        return log.exists() and log.stat().st_size > 0

    try:
        until(decided)
        process.send_signal(number)
        # From here on, whatever is written to it is an error.
        os.close(terminal)
        assert process.wait(PATIENCE_S) == 130
    finally:
        process.kill()
        process.wait()
    assert json.loads((tmp_path / "summary.json").read_bytes())["interrupted"]
    assert "Finished server process" in (tmp_path / "edge.log").read_text("utf-8")
