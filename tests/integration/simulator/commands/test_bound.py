"""`aicvds bound`: its output, Ctrl-C, and errors."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shared.world.scenario import SCENARIOS
from simulator.bound.clairvoyant_bound import replay
from simulator.commands.bound import main
from simulator.sites.site import Site

# The command in a separate process, which sends itself Ctrl-C while the solver searches.
INTERRUPTED_BOUND = """
import os, signal, sys, threading
from ortools.sat.python import cp_model
from simulator.commands.bound import main

solve = cp_model.CpSolver.solve

def solve_and_interrupt(solver, *arguments):
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    return solve(solver, *arguments)

cp_model.CpSolver.solve = solve_and_interrupt
sys.exit(main(["--seed", "0", "--scenario", "stress", "--time-limit-s", "600"]))
"""


def written(path: Path) -> Iterator[tuple[str, Any]]:
    yield from json.loads(path.read_text()).items()


def test_the_command_prints_and_writes_the_bound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "bound.json"
    assert main(["--seed", "0", "--steps", "12", "--out", str(out)]) == 0
    record = dict(written(out))
    assert record["lower_bound"] == record["lost_packets"] <= record["eof_lost_packets"]
    assert (record["optimal"], record["gap"], record["scenario"], record["steps"]) == (True, 0, "paper", 12)
    site = Site(SCENARIOS["paper"].model_copy(update={"steps": 12}))
    assert replay(site, 0, np.array(record["actions"])) == record["lost_packets"]
    shown = capsys.readouterr().out
    assert "proven optimal" in shown
    assert "bound.json" in shown
    assert main(["--seed", "0", "--steps", "12", "--out", str(out)]) == 2
    assert "bound.json: File exists" in capsys.readouterr().err and dict(written(out)) == record


def test_a_world_that_cannot_be_searched_leaves_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seed", "0", "--scenario", "windy", "--out", str(tmp_path / "bound.json")]) == 2
    assert "wind" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_ctrl_c_prints_the_best_so_far() -> None:
    command = [sys.executable, "-c", INTERRUPTED_BOUND]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert "the best flight found" in done.stdout
    assert "EOF" in done.stdout


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--seed", "-1"], "--seed -1"),
        (["--seed", "0", "--time-limit-s", "0"], "--time-limit-s 0"),
        (["--seed", "0", "--scenario", "nowhere"], "unknown scenario 'nowhere'"),
        (["--seed", "0", "--steps", "0"], "--steps 0"),
    ],
)
def test_bad_use_is_one_line_that_names_the_option(
    options: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(options) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
