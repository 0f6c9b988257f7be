"""The paper's table in the two schemes, and that they learn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

from lab.marl import madqn, mappo
from lab.marl.evaluate import lost_packets
from lab.marl.training import MarlScheme
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.world.environment import PipelineWorld

pytestmark = pytest.mark.long

PAPER = SCENARIOS["paper"]
MAKE: dict[str, Callable[[Scenario, int, int], MarlScheme]] = {"madqn": madqn.Madqn, "mappo": mappo.Mappo}


@pytest.fixture(params=["madqn", "mappo"])
def learner(request: pytest.FixtureRequest) -> MarlScheme:
    torch.manual_seed(0)
    return MAKE[request.param](PAPER, 120, 5_000_000)


def test_the_table_of_the_paper() -> None:
    assert (madqn.DISCOUNT, madqn.LEARNING_RATE, madqn.BATCH, madqn.REPLAY) == (0.99, 5e-4, 100, 1_000_000)
    assert (madqn.TAU, madqn.UPDATE_TARGET_EVERY, madqn.EPISODES) == (0.005, 3, 1000)
    assert (mappo.LEARNING_RATE, mappo.CLIP, mappo.ENTROPY, mappo.VALUE, mappo.EPOCHS) == (3e-4, 0.2, 0.01, 0.5, 4)


def test_a_trunk_of_400_and_300_with_a_head_of_sensors_and_one_of_velocities(learner: MarlScheme) -> None:
    layers = [layer for layer in learner.network.modules() if isinstance(layer, nn.Linear)]
    assert [layer.out_features for layer in layers] == [400, 300, 10 + 15]


def test_the_library_got_the_tables_numbers() -> None:
    dqn, ppo = madqn.Madqn(PAPER, 100, 0), mappo.Mappo(PAPER, 40, 0)
    assert dqn._optimiser.param_groups[0]["lr"] == 5e-4
    assert dqn._loss.value_estimator.gamma == pytest.approx(0.99)
    assert dqn._replay.batch_size == 100
    assert ppo._optimiser.param_groups[0]["lr"] == 3e-4
    assert float(ppo._loss.clip_epsilon) == pytest.approx(0.2)
    assert float(ppo._loss.entropy_coeff) == pytest.approx(0.01)
    assert float(ppo._loss.critic_coeff) == pytest.approx(0.5)


def test_the_target_follows_every_third_iteration_by_tau() -> None:
    torch.manual_seed(0)
    scheme = madqn.Madqn(PAPER, 100, 0)
    scheme.round()
    for _ in range(3 - scheme._iterations % 3):
        before = scheme._loss.target_value_network_params.flatten_keys(".").clone()
        scheme._iterate()
    after = scheme._loss.target_value_network_params.flatten_keys(".")
    online = scheme._loss.value_network_params.flatten_keys(".")
    for name, value in after.items():
        torch.testing.assert_close(value, before[name] + 0.005 * (online[name] - before[name]))


def test_a_round_moves_the_weights_and_leaves_a_finite_loss(learner: MarlScheme) -> None:
    before = [value.clone() for value in learner.network.state_dict().values()]
    flown = learner.round()
    after = learner.network.state_dict().values()
    assert np.isfinite(flown.loss)
    assert flown.lost_packets > 0 > flown.reward
    assert not all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_two_choices_are_drawn_apart_and_only_where_allowed() -> None:
    logits = torch.tensor([2.0, 0.0, 1.0, 0.0, 0.0, 3.0]).expand(500, 6)
    mask = torch.tensor([False, True, True, True, True, True]).expand(500, 6)
    both = mappo.SlotAndVelocity(logits, mask, velocities=3)
    torch.manual_seed(0)
    drawn = both.sample()
    assert set(drawn[:, 0].tolist()) == {1, 2}
    assert set(drawn[:, 1].tolist()) == {0, 1, 2}
    assert both.mode[0].tolist() == [2, 2]
    slot, velocity = torch.softmax(torch.tensor([0.0, 1.0]), 0), torch.softmax(torch.tensor([0.0, 0.0, 3.0]), 0)
    torch.testing.assert_close(both.log_prob(torch.tensor([[1, 2]]).expand(500, 2))[0], (slot[0] * velocity[2]).log())
    entropy = -(slot * slot.log()).sum() - (velocity * velocity.log()).sum()
    torch.testing.assert_close(both.entropy()[0], entropy)


def test_forty_missions_of_madqn_beat_random() -> None:
    torch.manual_seed(1)
    scheme = madqn.Madqn(PAPER, 100, 5_000_000)
    for _ in range(4):
        scheme.round()
    seeds = range(20)
    random = [sum(t.lost_packets for t in rollout(PipelineWorld(), policy_named("random"), seed)) for seed in seeds]
    assert lost_packets(PAPER, scheme.network, seeds).mean() < 0.7 * np.mean(random)
