"""The metrics of `aicvds simulate --metrics-port`, and how long they are served."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from simulator.commands import simulate
from simulator.records.summary import Summary
from tests.support.edge_stub import EdgeStub, free_port, stub_edge
from tests.support.waiting import PATIENCE_S, until


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


def numbers(port: int) -> dict[str, float]:
    """The numbers at the port by series; empty if no server listens."""
    try:
        text = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S).text
    except httpx.TransportError:
        return {}
    lines = (line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    return {series: float(number) for series, number in lines}


@contextmanager
def flying(stub: EdgeStub, out: Path, port: int, steps: int) -> Iterator[subprocess.Popen[str]]:
    arguments = ["simulate", "--edge", stub.url, "--steps", str(steps), "--no-bound", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "shared.kit.command_line", *arguments, "--metrics-port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.long
def test_the_last_scrape_has_the_whole_flight(stub: EdgeStub, tmp_path: Path) -> None:
    port, last = free_port(), dict[str, float]()
    with flying(stub, tmp_path, port, steps=4) as process:
        while process.poll() is None:
            # As far apart as Prometheus's: without a wait, the flight would end between two scrapes.
            last = numbers(port) or last
            time.sleep(0.5)
        assert process.returncode == 0
    summary = Summary.model_validate_json((tmp_path / "summary.json").read_bytes())
    by_source = {key: n for key, n in last.items() if key.startswith("aicvds_flight_decisions_total")}
    assert by_source == {
        'aicvds_flight_decisions_total{reason="none",source="llm"}': summary.by_source.llm,
        'aicvds_flight_decisions_total{reason="llm_timeout",source="policy"}': summary.by_source.policy,
    }
    assert last["aicvds_flight_round_trip_seconds_count"] == summary.decisions == 12
    assert last["aicvds_flight_lost_packets_total"] == summary.lost_packets["aic_vds"]
    failures, overflows = (last[f"aicvds_flight_{x}_total"] for x in ("failed_transmissions", "overflows"))
    assert (failures, failures + overflows) == (summary.failures, summary.loss_events["aic_vds"])
    assert last["aicvds_flight_collected_packets_total"] > 0
    assert last["aicvds_flight_steps"] == last["aicvds_flight_steps_flown"] == 4
    assert not any(summary.mission_id in series or "uav" in series for series in last)


@pytest.fixture
def for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight that waits for a scrape does not end."""
    monkeypatch.setattr("simulator.flying.flight_metrics.LONGEST_LAST_SCRAPE_S", 3600.0)


@pytest.mark.usefixtures("for_ever", "undrawn")
def test_a_flight_that_is_never_scraped_does_not_wait(stub: EdgeStub, tmp_path: Path) -> None:
    arguments = ["--edge", stub.url, "--steps", "1", "--out", str(tmp_path), "--metrics-port", str(free_port())]
    assert simulate.main(arguments) == 0


@pytest.mark.long
@pytest.mark.usefixtures("for_ever", "undrawn")
def test_an_interrupted_flight_waits_for_no_scrape(stub: EdgeStub, tmp_path: Path) -> None:
    # The second step is never flown.
    stub.script, stub.otherwise, port = ["ok"] * 3, "slow", free_port()

    def interrupt() -> None:
        until(lambda: stub.gate.callers and numbers(port).get("aicvds_flight_steps_flown"))
        os.kill(os.getpid(), signal.SIGTERM)

    scraper = threading.Thread(target=interrupt, daemon=True)
    scraper.start()
    assert simulate.main(["--edge", stub.url, "--out", str(tmp_path), "--metrics-port", str(port)]) == 130
    scraper.join()
    assert Summary.model_validate_json((tmp_path / "summary.json").read_bytes()).interrupted


def test_a_port_that_is_taken_is_one_line(stub: EdgeStub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = stub.url.rsplit(":", 1)[1]
    for wanted, message in ((port, "Address already in use"), ("70000", "not between 0 and 65535")):
        arguments = ["--edge", stub.url, "--out", str(tmp_path), "--metrics-port", wanted]
        assert simulate.main(arguments) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"--metrics-port {wanted}" in error and message in error
