"""The modules' start: recorded by exploring UAVs, trained, shipped, and better than none."""

from pathlib import Path

import numpy as np
import pytest

from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, RolloutStep, read_rollouts, write_rollouts
from lab.training.modules import Modules
from lab.training.reward import Reward
from lab.training.rollout_examples import Example, ExampleBatch, replay
from lab.training.teacher_agreement import recall, references
from lab.training.training_loop import losses
from service.learning import initial_weights as checkpoints
from service.learning.initial_weights import initial_weights
from shared.wire.schemas import Features
from shared.world.scenario import SCENARIOS, Scenario
from tests.support.processes import run_lab, run_lab_here

PAPER = SCENARIOS["paper"]
# Far past the training worlds that `python -m lab explore` records by default.
HELD_OUT = range(50_000, 50_004)


@pytest.fixture(scope="module")
def flown() -> list[RolloutStep]:
    return [step for n in HELD_OUT for step in explore(PAPER, n, "clairvoyant" if n % 2 else "planner")]


@pytest.fixture(scope="module")
def untaught() -> list[RolloutStep]:
    return [step for n in HELD_OUT for step in explore(PAPER, n)]


def held_out(flown: list[RolloutStep], features: Features = "paper") -> list[Example]:
    header = Header(scenario=PAPER, missions=len(HELD_OUT), behaviour="test")
    return [example for mission in replay(header, flown, Reward("immediate"), features) for example in mission]


@pytest.mark.long
@pytest.mark.parametrize(
    ("teacher", "features", "k", "least"),
    [
        # Its start was trained on look-ahead alone.
        ("look_ahead", "paper", 5, 0.85),
        ("look_ahead", "paper", 3, 0.75),
        ("planner", "reach", 5, 0.95),
        ("planner", "reach", 3, 0.85),
        ("clairvoyant", "reach", 5, 0.95),
        ("clairvoyant", "reach", 3, 0.85),
    ],
)
def test_the_shipped_checkpoint_keeps_the_sensor_that_matters(
    features: Features, k: int, least: float, teacher: str, flown: list[RolloutStep], untaught: list[RolloutStep]
) -> None:
    taught = references(held_out(untaught if teacher == "look_ahead" else flown, features))[teacher]
    assert len(taught) > 50
    shipped = recall(initial_weights("pretrained", features, 15, seed=0), taught, k)
    random = recall(initial_weights("random", features, 15, seed=0), taught, k)
    assert shipped >= least
    assert shipped > random + 0.1


@pytest.mark.parametrize("features", ["paper", "reach"])
def test_a_scenario_with_a_lower_speed_limit_takes_the_levels_that_it_has(features: Features) -> None:
    slow = PAPER.model_copy(update={"max_velocity": 8})
    header = Header(scenario=slow, missions=1, behaviour="test")
    sample = next(replay(header, explore(slow, 50_000), Reward("immediate"), features))[0].sample
    scores, values = Modules(features, 9, seed=0, init="pretrained").evaluate(sample)
    assert scores.shape == (len(sample.features),)
    assert values.shape == (9,)


@pytest.mark.parametrize("features", ["paper", "reach"])
def test_a_batch_loses_what_its_examples_lose_one_by_one(features: Features, untaught: list[RolloutStep]) -> None:
    examples, modules = held_out(untaught, features)[:40], Modules(features, 15, seed=0)
    regression, _ = losses(modules, ExampleBatch.of(examples))
    alone = [modules.loss(example.sample, example.reward).item() for example in examples]
    assert len({len(example.sample.features) for example in examples}) > 1
    assert regression.item() == pytest.approx(sum(alone) / len(alone), rel=1e-4)


def test_a_checkpoint_of_another_preset_is_not_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "checkpoints").mkdir()
    Modules("paper", 15, seed=0).save(tmp_path / "checkpoints" / "reach.npz")
    monkeypatch.setattr(checkpoints, "files", lambda package: tmp_path)
    with pytest.raises(ValueError, match=r"reach\.npz has modules of the feature preset paper"):
        checkpoints._packaged.__wrapped__("reach")


@pytest.mark.long
def test_explore_and_pretrain_end_to_end(tmp_path: Path) -> None:
    recorded, checkpoint = tmp_path / "r.jsonl.gz", tmp_path / "c" / "own.npz"
    assert run_lab("explore", "--out", str(recorded), "--missions", "2", "--untaught", "2").returncode == 0
    header, steps = read_rollouts(recorded)
    assert header.missions == 4
    assert [step.reference is not None for step in steps].count(True) > 100
    for features in ("paper", "reach"):
        weights = []
        # Once as a user starts it, and once more in this process.
        for run in (run_lab, run_lab_here):
            options = ("--out", str(checkpoint), "--epochs", "1", "--features", features)
            trained = run("pretrain", str(recorded), *options)
            assert trained.returncode == 0, trained.stderr
            assert "held-out loss" in trained.stdout
            assert "look_ahead's sensor in the top 5" in trained.stdout
            weights.append(dict(np.load(checkpoint)))
            assert weights[-1].pop("features") == features
        assert all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[0])


@pytest.mark.long
def test_the_papers_target_learns_something_else(tmp_path: Path) -> None:
    recorded, weights = tmp_path / "r.jsonl.gz", []
    assert run_lab_here("explore", "--out", str(recorded), "--missions", "0", "--untaught", "2").returncode == 0
    for target in ("return", "immediate"):
        out = tmp_path / f"{target}.npz"
        trained = run_lab_here("pretrain", str(recorded), "--out", str(out), "--epochs", "1", "--target", target)
        assert trained.returncode == 0, trained.stderr
        weights.append(np.load(out)["attention.score.weight"])
    assert not np.array_equal(*weights)


@pytest.mark.parametrize(
    ("option", "said"),
    [("--epochs", "not at least 1"), ("--temperature", "not above 0"), ("--batch", "not at least 1")],
)
def test_bad_use_is_one_clear_line(tmp_path: Path, option: str, said: str) -> None:
    ended = run_lab_here("pretrain", str(tmp_path / "r.gz"), "--out", str(tmp_path / "c.npz"), option, "0")
    assert ended.returncode == 2
    assert f"{option} 0 is {said}" in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_run_without_a_file_is_one_clear_line(tmp_path: Path) -> None:
    ended = run_lab_here("pretrain", "--out", str(tmp_path / "c.npz"))
    assert ended.returncode == 2
    assert "name a file" in ended.stderr


def recorded(path: Path, scenario: Scenario, missions: int = 2) -> Path:
    header = Header(scenario=scenario, missions=missions, behaviour="test")
    write_rollouts(path, header, (step for n in range(missions) for step in explore(scenario, n)))
    return path


def test_several_files_train_one_checkpoint_and_each_is_reported(tmp_path: Path) -> None:
    short = [SCENARIOS[name].model_copy(update={"steps": 12}) for name in ("paper", "shadowed")]
    files = [recorded(tmp_path / f"{scenario.name}.gz", scenario) for scenario in short]
    printed, weights = [], []
    for chosen in (files, files[:1]):
        out = tmp_path / f"{len(chosen)}.npz"
        ended = run_lab_here("pretrain", *map(str, chosen), "--out", str(out), "--epochs", "1", "--features", "reach")
        assert ended.returncode == 0, ended.stderr
        printed.append(ended.stdout)
        weights.append(np.load(out)["attention.score.weight"])
    assert "Scenario paper" in printed[0]
    assert "Scenario shadowed" in printed[0]
    assert "Scenario shadowed" not in printed[1]
    assert not np.array_equal(*weights)


def test_files_whose_uavs_have_other_velocities_are_refused(tmp_path: Path) -> None:
    fast = PAPER.model_copy(update={"steps": 12})
    slow = fast.model_copy(update={"max_velocity": 8})
    files = [recorded(tmp_path / "fast.gz", fast), recorded(tmp_path / "slow.gz", slow)]
    ended = run_lab_here("pretrain", *map(str, files), "--out", str(tmp_path / "c.npz"))
    assert ended.returncode == 2
    assert "up to 14 m/s" in ended.stderr
    assert "up to 8 m/s" in ended.stderr


def test_a_file_whose_recording_was_stopped_is_one_clear_line(tmp_path: Path) -> None:
    whole = recorded(tmp_path / "whole.gz", PAPER.model_copy(update={"steps": 12}))
    cut = tmp_path / "cut.gz"
    cut.write_bytes(whole.read_bytes()[:-500])
    ended = run_lab_here("pretrain", str(cut), "--out", str(tmp_path / "c.npz"))
    assert ended.returncode == 2
    assert "its recording was stopped" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("content", [b"", b"not gzip"])
def test_a_broken_file_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "r.gz").write_bytes(content)
    ended = run_lab_here("pretrain", str(tmp_path / "r.gz"), "--out", str(tmp_path / "c.npz"))
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    assert "r.gz" in ended.stderr or "gzip" in ended.stderr
