"""Checkpoints of trained networks: those that ship, and invalid files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lab.marl.checkpoint import shipped
from lab.marl.curve import read_csv
from lab.marl.learned import Learned
from shared.world.scenario import SCENARIOS
from tests.support.places import ROOT

PAPER = SCENARIOS["paper"]
SCHEMES = ["madqn", "mappo"]
CHECKPOINTS = ROOT / "lab" / "marl" / "checkpoints"


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_shipped_weights_are_small_and_say_where_they_come_from(scheme: str) -> None:
    assert (CHECKPOINTS / f"{scheme}.pt").stat().st_size < 5_000_000
    held = shipped(scheme)
    assert (held.scheme, held.scenario, held.seed) == (scheme, PAPER, 0)
    assert held.command.endswith(f"train {scheme} --out runs/{scheme}")
    assert {value.dtype for value in held.weights.values()} == {torch.float32}


def test_madqn_was_trained_for_the_papers_thousand_episodes() -> None:
    assert shipped("madqn").episodes == 1000


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_shipped_learning_curve_rises(scheme: str) -> None:
    points = read_csv(CHECKPOINTS / f"{scheme}.csv")
    fifth = len(points) // 5
    first, last = points[:fifth], points[-fifth:]
    assert points[-1].episode == shipped(scheme).episodes
    assert np.mean([p.lost_packets for p in last]) < 0.7 * np.mean([p.lost_packets for p in first])
    assert np.mean([p.episode_return for p in last]) > np.mean([p.episode_return for p in first])


@pytest.mark.parametrize("content", [b"", b"rubbish"])
def test_a_file_that_holds_no_weights_is_one_clear_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "bad.pt").write_bytes(content)
    with pytest.raises(ValueError, match="bad.pt is no checkpoint of `python -m lab train`"):
        Learned("madqn", tmp_path / "bad.pt")


def test_a_state_to_resume_from_is_no_policy(tmp_path: Path) -> None:
    torch.save({"episodes": 3}, tmp_path / "state.pt")
    with pytest.raises(ValueError, match="state.pt has no trained policy: train one with `python -m lab train`"):
        Learned("madqn", tmp_path / "state.pt")
