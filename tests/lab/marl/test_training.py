"""A training: reproducible, resumable, and its files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lab.marl import checkpoint, madqn, mappo, paper_madqn
from lab.marl.curve import Point, plot, read_csv, write_csv
from lab.marl.plan import STATE, TrainingPlan
from lab.marl.training import _HELD_OUT, MarlScheme, Round, Training
from lab.training_seeds import FIRST_TRAINING_SEED
from shared.world.scenario import Scenario
from simulator.errors import UsageError

pytestmark = pytest.mark.long

SMALL = Scenario(name="small", sensors=4, uavs=2, steps=6)
MAKE: dict[str, Callable[[Scenario, int, int], MarlScheme]] = {
    "madqn": madqn.Madqn,
    "mappo": mappo.Mappo,
    "madqn_paper": paper_madqn.PaperMadqn,
}
ROUNDS = 6
WORLDS = {"madqn": madqn.WORLDS, "mappo": mappo.WORLDS, "madqn_paper": madqn.WORLDS}


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan with few missions, and learning from the start."""
    monkeypatch.setattr(madqn, "WARM_UP", 150)
    monkeypatch.setattr(paper_madqn, "WARM_UP", 150)


def plan_of(scheme: str, seed: int = 0, rounds: int = ROUNDS) -> TrainingPlan:
    return TrainingPlan(scheme, SMALL, rounds * WORLDS[scheme], seed, threads=1)


def begun(plan: TrainingPlan, out: Path) -> Training:
    return Training(plan, MAKE[plan.scheme], out)


def quiet(_: Round) -> None:
    pass


def trained(plan: TrainingPlan, out: Path) -> dict[str, Tensor]:
    training = begun(plan, out)
    training.run(quiet, save_every_s=3600)
    return training.learner.network.state_dict()


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("scheme", list(MAKE))
def test_resumed_after_an_interrupt_it_ends_with_the_same_weights_and_curve(scheme: str, tmp_path: Path) -> None:
    plan = plan_of(scheme)
    whole = begun(plan, tmp_path / "whole")
    whole.run(quiet, save_every_s=3600)

    rounds = 0

    def interrupt(_: Round) -> None:
        nonlocal rounds
        rounds += 1
        if rounds == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begun(plan, tmp_path / "cut").run(interrupt, save_every_s=0)
    torch.rand(7)
    resumed = begun(plan, tmp_path / "cut")
    resumed.resume()
    assert resumed.episodes == 3 * WORLDS[scheme]
    resumed.run(quiet, save_every_s=3600)
    assert same(whole.learner.network.state_dict(), resumed.learner.network.state_dict())
    assert resumed.points == whole.points
    assert [point.episode for point in whole.points] == [WORLDS[scheme] * n for n in range(1, ROUNDS + 1)]


def test_another_seed_gives_other_weights(tmp_path: Path) -> None:
    one, again, other = (
        trained(plan_of("mappo", seed, rounds=1), tmp_path / str(n)) for n, seed in enumerate((0, 0, 1))
    )
    assert same(one, again)
    assert not same(one, other)


def test_training_worlds_are_no_evaluation_seeds_and_no_held_out_ones() -> None:
    plans = [plan_of("madqn", seed) for seed in (0, 1, 2**32 - 1)]
    worlds = [range(plan.first_seed, plan.first_seed + 1_000_000) for plan in plans]
    assert min(FIRST_TRAINING_SEED, _HELD_OUT.start) == 1_000_000
    assert _HELD_OUT.stop <= worlds[0].start
    assert worlds[0].stop <= worlds[1].start


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "--seed differs from the training in .*, which began with 0"),
        ({"episodes": 80}, "--episodes differs from the training in .*, which began with 60"),
        ({"scenario": Scenario(name="other", sensors=4, uavs=2, steps=6)}, "--scenario differs .*: give the same"),
    ],
)
def test_resuming_with_other_options_is_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    begun(plan_of("madqn"), tmp_path).save()
    plan = replace(plan_of("madqn"), **change)
    with pytest.raises(UsageError, match=message):
        begun(plan, tmp_path).resume()


def test_resuming_from_nothing_or_from_rubbish_is_refused(tmp_path: Path) -> None:
    training = begun(plan_of("madqn"), tmp_path)
    with pytest.raises(UsageError, match="--resume: there is no state.pt in .*; start without --resume"):
        training.resume()
    (tmp_path / STATE).write_bytes(b"rubbish")
    with pytest.raises(UsageError, match="--resume: .*state.pt is no checkpoint of `python -m lab train`"):
        training.resume()


def test_episodes_that_make_no_whole_rounds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--episodes 25 is not a multiple of 10"):
        begun(TrainingPlan("madqn", SMALL, 25, 0, 1), tmp_path)


def test_a_save_cut_short_leaves_the_state_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint.write({"episodes": 10}, tmp_path / STATE)

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space left"):
        checkpoint.write({"episodes": 20}, tmp_path / STATE)
    assert checkpoint.read(tmp_path / STATE) == {"episodes": 10}


def test_the_curve_is_read_as_it_was_written_and_drawn(tmp_path: Path) -> None:
    points = [Point(10, 500.5, -99.25, 0.5, 400.0), Point(20, 300.0, -50.0, 0.25, 200.0)]
    write_csv(points, tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_text().splitlines()[:2] == [
        "episode,lost_packets,episode_return,loss,greedy_lost_packets",
        "10,500.5,-99.25,0.5,400.0",
    ]
    assert read_csv(tmp_path / "c.csv") == points
    plot(points, "MADQN", tmp_path / "c")
    assert (tmp_path / "c.png").stat().st_size > 1000
    assert "<svg" in (tmp_path / "c.svg").read_text()
