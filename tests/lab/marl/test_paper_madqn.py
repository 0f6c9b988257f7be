"""The paper's MADQN: independent agents on the plain state, by its table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from lab.marl import madqn, paper_madqn
from lab.marl.checkpoint import PolicyCheckpoint
from lab.marl.evaluate import lost_packets
from lab.marl.learned import Learned
from lab.marl.networks import IndependentAgents, plain_state
from lab.marl.paper_madqn import PaperMadqn
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import rollout
from simulator.world.environment import PipelineWorld

PAPER = SCENARIOS["paper"]
SMALL = Scenario(name="small", sensors=4, uavs=2, steps=6)


def test_each_uav_has_its_own_trunk_replay_and_optimiser_of_the_papers_sizes() -> None:
    scheme = PaperMadqn(PAPER, 20, 0)
    for agent in scheme._online.agents:
        layers = [layer for layer in agent.modules() if isinstance(layer, nn.Linear)]
        assert [(layer.in_features, layer.out_features) for layer in layers] == [(32, 400), (400, 300), (300, 25)]
    own = {id(parameter) for optimiser in scheme._optimisers for parameter in optimiser.param_groups[0]["params"]}
    assert len(own) == 3 * 6
    assert {optimiser.param_groups[0]["lr"] for optimiser in scheme._optimisers} == {5e-4}


def test_the_plain_state_is_what_the_uav_heard() -> None:
    observations, _ = PipelineWorld().reset(seed=0)
    own = observations["uav_0"]
    position, queue, battery, gain = np.split(plain_state(PAPER, own).numpy(), [2, 12, 22])
    heard = own["last_heard"] >= 0
    np.testing.assert_allclose(position, own["position"] / 1000, rtol=1e-5)
    np.testing.assert_allclose(queue[heard], own["queue"][heard] / 60, rtol=1e-5)
    assert 0 < heard.sum() < 10
    for column in (queue, battery, gain):
        assert (column[heard] > 0).all()
        assert (column[~heard] == 0).all()


def test_every_agent_learns_and_the_target_follows_by_tau(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(paper_madqn, "WARM_UP", 0)
    scheme = PaperMadqn(SMALL, 20, 0)
    scheme.round()
    while scheme._iterations % madqn.UPDATE_TARGET_EVERY != madqn.UPDATE_TARGET_EVERY - 1:
        scheme._iterate()
    before = [parameter.clone() for parameter in scheme._target.parameters()]
    online = [parameter.clone() for parameter in scheme._online.parameters()]
    scheme._iterate()
    for old, own, was, new in zip(
        before, scheme._target.parameters(), online, scheme._online.parameters(), strict=True
    ):
        torch.testing.assert_close(own, old + madqn.TAU * (new - old))
        assert not torch.equal(was, new)


def test_it_explores_less_as_it_goes() -> None:
    scheme = PaperMadqn(SMALL, 20, 0)
    shares = [scheme.epsilon]
    for _ in range(2):
        scheme.round()
        shares.append(scheme.epsilon)
    assert shares[0] == 1.0
    assert shares[1] == pytest.approx(madqn.EPSILON_END)
    assert shares[2] == pytest.approx(madqn.EPSILON_END)


def test_its_agents_learn_to_name_the_one_sensor_that_pays() -> None:
    torch.manual_seed(0)
    scheme = PaperMadqn(SMALL, 20, 0)
    state = torch.rand((400, 14))
    for replay in scheme._replays:
        choice = torch.stack((torch.randint(4, (400,)), torch.randint(15, (400,))), dim=1)
        replay.add(
            state=state, choice=choice, reward=(choice[:, 0] == 2).float(), following=state, done=torch.ones(400)
        )
    for _ in range(150):
        scheme._iterate()
    for uav in range(2):
        assert (scheme._online.greedy(uav, state)[:, 0] == 2).float().mean() > 0.95


def test_the_saved_policy_flies_as_the_batched_evaluation(tmp_path: Path) -> None:
    torch.manual_seed(0)
    agents = IndependentAgents(SMALL)
    path = tmp_path / "madqn_paper.pt"
    PolicyCheckpoint("madqn_paper", SMALL, 10, 0, "python -m lab train madqn_paper", "0", agents.state_dict()).save(
        path
    )
    flown = [rollout(PipelineWorld(SMALL), Learned("madqn_paper", path), seed) for seed in range(3)]
    assert lost_packets(SMALL, agents, range(3)).tolist() == [sum(t.lost_packets for t in tally) for tally in flown]
