"""The learned schemes as policies: greedy, reproducible, and for matching scenarios only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lab.marl.checkpoint import PolicyCheckpoint, shipped
from lab.marl.evaluate import lost_packets
from lab.marl.learned import Learned
from lab.marl.networks import two_heads
from shared.world.scenario import SCENARIOS, Scenario
from simulator.errors import UsageError
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.world.environment import PipelineWorld

PAPER = SCENARIOS["paper"]
SMALL = Scenario(name="small", sensors=4, uavs=2, steps=6)
SCHEMES = ["madqn", "mappo"]


def saved(path: Path, scenario: Scenario = SMALL) -> Path:
    torch.manual_seed(0)
    weights = two_heads(scenario).state_dict()
    PolicyCheckpoint("madqn", scenario, 10, 0, "python -m lab train madqn", "0", weights).save(path)
    return path


def lost(policy: str, seed: int) -> int:
    return sum(t.lost_packets for t in rollout(PipelineWorld(), policy_named(policy), seed))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_beats_random_by_far_on_evaluation_worlds(scheme: str) -> None:
    random = [lost("random", seed) for seed in range(6)]
    assert sum(lost(f"lab.marl.learned:{scheme}", seed) for seed in range(6)) < 0.5 * sum(random)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_batched_evaluation_in_training_is_that_of_the_policy(scheme: str) -> None:
    network = shipped(scheme).network(PAPER)
    assert lost_packets(PAPER, network, range(4)).tolist() == [
        lost(f"lab.marl.learned:{scheme}", seed) for seed in range(4)
    ]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_is_greedy_so_the_policys_seed_does_not_matter(scheme: str) -> None:
    observations, _ = PipelineWorld().reset(seed=3)
    chosen = set()
    for seed in range(3):
        policy = policy_named(f"lab.marl.learned:{scheme}")
        policy.reset(PAPER, seed)
        chosen.add(policy.decide(0, observations["uav_0"], frozenset()))
    assert len(chosen) == 1


def test_it_takes_free_sensors_that_were_heard(tmp_path: Path) -> None:
    policy = Learned("madqn", saved(tmp_path / "own.pt"))
    policy.reset(SMALL, 0)
    drawn = (PipelineWorld(SMALL).reset(seed=seed)[0] for seed in range(50))
    observations = next(o for o in drawn if np.count_nonzero(o["uav_0"]["last_heard"] >= 0) == 2)
    heard = set(np.flatnonzero(observations["uav_0"]["last_heard"] >= 0).tolist())
    one, other = sorted(heard)
    for taken in (set[int](), {one}, {other}, heard, {0, 1, 2}):
        sensor, velocity = policy.decide(0, observations["uav_0"], frozenset(taken))
        assert sensor not in taken
        assert sensor in heard or not heard - taken
        assert 0 <= velocity <= 14
    assert policy.decide(0, observations["uav_0"], frozenset(range(4)))[0] in range(4)


def test_the_error_for_another_size_names_the_training_command() -> None:
    policy = policy_named("lab.marl.learned:madqn")
    message = "madqn was trained for sensors 10, scenario dense has 100: train one with `python -m lab train madqn"
    with pytest.raises(ValueError, match=message) as refused:
        policy.reset(SCENARIOS["dense"], 0)
    assert isinstance(refused.value, UsageError), "a command shows it as one line"
    # A changed scenario's name is no preset's.
    changed = SCENARIOS["dense"].model_copy(update={"name": "dense_changed_1a2b3c"})
    with pytest.raises(ValueError, match="--scenario dense` with the same --sensors"):
        policy.reset(changed, 0)


def test_weights_of_ones_own_fly_the_scenario_they_were_trained_in(tmp_path: Path) -> None:
    policy = Learned("madqn", saved(tmp_path / "own.pt"))
    assert len(rollout(PipelineWorld(SMALL), policy, seed=0)) == 6
