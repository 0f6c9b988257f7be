"""``python -m lab train`` as a user runs it: killed, resumed, misused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lab.marl.checkpoint import PolicyCheckpoint
from lab.marl.curve import read_csv
from tests.support.processes import run_lab, run_lab_here
from tests.support.waiting import until

EPISODES = ("--episodes", "120")
# A training that goes no further than its first save.
STANDS_STILL = """
import signal, sys
from lab.commands import train
from lab.marl import training

save = training.Training.save

def stand_still(self):
    save(self)
    signal.pause()

training.Training.save = stand_still
sys.exit(train.main(sys.argv[1:]))
"""


def weights_of(folder: Path) -> list[list[float]]:
    return [value.flatten().tolist() for value in PolicyCheckpoint.load(folder / "mappo.pt").weights.values()]


@pytest.mark.long
def test_killed_and_resumed_it_ends_with_the_weights_of_a_training_left_alone(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    ended = run_lab_here("train", "mappo", *EPISODES, "--out", str(whole))
    assert ended.returncode == 0, ended.stderr
    command = [sys.executable, "-c", STANDS_STILL, "mappo", *EPISODES, "--out", str(killed), "--save-s", "0"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: (killed / "state.pt").exists() or process.poll() is not None)
    finally:
        process.kill()
        process.wait()
    assert (killed / "state.pt").exists() and not (killed / "mappo.pt").exists()
    resumed = run_lab("train", "mappo", *EPISODES, "--out", str(killed), "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert weights_of(killed) == weights_of(whole)
    assert read_csv(killed / "mappo.csv") == read_csv(whole / "mappo.csv")
    for folder in (whole, killed):
        left = {path.suffix for path in folder.glob("mappo.*")}
        assert left == {".pt", ".csv", ".png", ".svg"}
        assert list((folder / "tensorboard").glob("events.*"))
    again = run_lab_here("train", "mappo", *EPISODES, "--out", str(whole))
    assert again.returncode == 2
    assert "has a training: give --resume" in again.stderr


def test_help_teaches() -> None:
    reported = run_lab_here("train", "--help").stdout
    for word in ("madqn", "mappo", "--resume", "--episodes", "tensorboard"):
        assert word in reported


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["madqn", "--episodes", "0"], "--episodes 0 is not between 1 and 1000000"),
        (["madqn", "--seed", "-1"], "--seed -1 is not between 0 and 4294967295"),
        (["madqn", "--threads", "0"], "--threads 0 is not between 1 and 64"),
        (["madqn", "--save-s", "-1"], "--save-s -1 is not between 0 and 3600"),
        (["madqn", "--scenario", "moon"], "--scenario: unknown scenario 'moon'"),
    ],
)
def test_bad_use_is_one_line_that_names_the_option(options: list[str], message: str) -> None:
    ended = run_lab_here("train", *options)
    assert ended.returncode == 2
    assert message in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1
