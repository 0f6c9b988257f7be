"""The TorchRL environment: its specs, and the worlds behind it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from lab.marl.env import PipelineEnv
from lab.pettingzoo_world import PettingZooWorld
from shared.world.scenario import Scenario

pytestmark = pytest.mark.long

SMALL = Scenario(name="small", sensors=4, uavs=2, steps=5)


def test_it_keeps_its_own_specs() -> None:
    check_env_specs(PipelineEnv(SMALL, worlds=3, first_seed=7))


def test_each_reset_draws_the_next_worlds() -> None:
    env = PipelineEnv(SMALL, worlds=2, first_seed=7)
    first, second = env.reset()["state"], env.reset()["state"]
    for state, seed in zip((*first, *second), (7, 8, 9, 10), strict=True):
        world = PettingZooWorld(SMALL)
        world.reset(seed=seed)
        np.testing.assert_array_equal(state.numpy(), world.state())


def test_an_action_names_a_slot_and_the_reward_is_the_worlds() -> None:
    env, world = PipelineEnv(SMALL, worlds=1, first_seed=3), PettingZooWorld(SMALL, cost="paper")
    seen = env.reset()
    world.reset(seed=3)
    for step in range(SMALL.steps):
        order = env._order[0]
        seen["agents", "action"] = torch.tensor([[[1, 14], [2, 5]]])
        seen = env.step(seen)["next"]
        _, rewards, *_ = world.step({"uav_0": [order[0, 1], 14], "uav_1": [order[1, 2], 5]})
        assert seen["agents", "reward"].flatten().tolist() == list(rewards.values())
        assert seen["lost_packets"].item() == world.tally[-1].lost_packets
        assert (seen["done"].item(), seen["terminated"].item()) == (step == 4, step == 4)
