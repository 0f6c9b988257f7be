"""MADQN: every UAV learns the value of its own choices independently, with TorchRL's DQN loss and replay buffer."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, MultiOneHot, ReplayBuffer
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from lab.marl.env import PipelineEnv
from lab.marl.networks import two_heads
from lab.marl.training import Round
from shared.world.scenario import Scenario

# The paper's table.
DISCOUNT = 0.99
LEARNING_RATE = 5e-4
BATCH = 100
REPLAY = 1_000_000
TAU = 0.005
UPDATE_TARGET_EVERY = 3
EPISODES = 1000
# Not in the paper's table.
WORLDS = 10
ITERATIONS_A_STEP = 4
WARM_UP = 900
EPSILON_END = 0.05
EPSILON_SHARE = 0.5
# The prefix of the actor's first module in the loss's parameter names.
_VALUES = "module.0.module."


class Madqn:
    """Independent deep Q-learning with one network for all UAVs; the features identify the UAV.

    The value of a choice is the sum over its heads, ``Q(sensor) + Q(velocity)``: the library trains two heads this way,
    and neither head sees the choice of the other. An iteration is one gradient step on 100 transitions from the replay
    buffer. Every third iteration updates the target network by ``tau``. The target network averages many iterations, so
    it is steadier than the online network, and ``network`` returns it. The reward is minus the paper's P_l, the same
    for every UAV.

    Args:
        episodes: missions of the whole training, for the schedule of epsilon and the size of the replay buffer.
        first_seed: of the training worlds.
    """

    name = "madqn"
    worlds = WORLDS

    def __init__(self, scenario: Scenario, episodes: int, first_seed: int) -> None:
        self._steps = scenario.steps
        self._split = [scenario.sensors, scenario.max_velocity + 1]
        self._env = PipelineEnv(scenario, WORLDS, first_seed)
        online = two_heads(scenario)
        self._target = two_heads(scenario)
        choices = MultiOneHot(self._split)
        chooser = QValueModule(
            action_space="mult_one_hot",
            var_nums=self._split,
            action_mask_key="action_mask",
            out_keys=["choice", "action_value", "chosen_action_value"],
            spec=choices,
            strict_shape=False,
        )
        values = TensorDictModule(online, in_keys=["observation"], out_keys=["action_value"])
        self._actor = TensorDictSequential(values, chooser)
        self._explore = EGreedyModule(
            choices,
            eps_init=1.0,
            eps_end=EPSILON_END,
            annealing_num_steps=max(1, round(EPSILON_SHARE * episodes / WORLDS * scenario.steps)),
            action_key="choice",
            action_mask_key="action_mask",
        )
        self._loss = DQNLoss(self._actor, action_space="mult_one_hot", loss_function="smooth_l1", delay_value=True)
        self._loss.set_keys(action="choice")
        self._loss.make_value_estimator(gamma=DISCOUNT)
        self._follow = SoftUpdate(self._loss, tau=TAU)
        self._optimiser = torch.optim.Adam(self._loss.parameters(), lr=LEARNING_RATE, fused=True)
        # A short training never fills a larger buffer.
        capacity = min(REPLAY, episodes * scenario.steps * scenario.uavs)
        self._replay = ReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=BATCH)
        self._iterations = 0

    @property
    def network(self) -> nn.Module:
        """The target network."""
        weights = self._loss.target_value_network_params.flatten_keys(".")
        self._target.load_state_dict({name.removeprefix(_VALUES): weight for name, weight in weights.items()})
        return self._target

    def round(self) -> Round:
        """Fly ``worlds`` missions, and learn at each step."""
        before = self._env.reset()
        lost, reward, losses = 0.0, 0.0, [0.0]
        for _ in range(self._steps):
            agents = self._choose(before["agents"])
            slot, velocity = (part.argmax(-1) for part in agents["choice"].split(self._split, -1))
            before["agents", "action"] = torch.stack((slot, velocity), -1).view(*before["agents"].batch_size, 2)
            after = self._env.step(before)["next"]
            self._remember(agents, after)
            lost += float(after["lost_packets"].mean())
            reward += float(after["agents", "reward"].mean())
            if len(self._replay) >= WARM_UP:
                losses += [self._iterate() for _ in range(ITERATIONS_A_STEP)]
            before = after
        return Round(loss=sum(losses) / max(1, len(losses) - 1), lost_packets=lost, reward=reward)

    def state(self) -> dict[str, Any]:
        """The state for ``restore``, without that of the random generator."""
        return {
            "next_seed": self._env.next_seed,
            "iterations": self._iterations,
            "loss": self._loss.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "epsilon": self._explore.eps.clone(),
            "replay": self._replay[:].to_dict() if len(self._replay) else {},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a ``state``."""
        self._env.next_seed = state["next_seed"]
        self._iterations = state["iterations"]
        self._loss.load_state_dict(state["loss"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._explore.eps.copy_(state["epsilon"])
        if state["replay"]:
            self._replay.extend(TensorDict(state["replay"]).auto_batch_size_(1))

    def _choose(self, agents: TensorDict) -> TensorDict:
        flat = agents.select("observation", "action_mask").reshape(-1)
        with torch.no_grad():
            self._explore(self._actor(flat))
        self._explore.step()
        return flat

    def _remember(self, agents: TensorDict, after: TensorDict) -> None:
        rows = agents.batch_size[0]
        of_team = after["done"].repeat_interleave(rows // WORLDS, dim=0)
        following = after["agents"].select("observation", "action_mask", "reward").reshape(-1)
        following["done"], following["terminated"] = of_team, of_team.clone()
        transitions = agents.select("observation", "action_mask")
        transitions["choice"], transitions["next"] = agents["choice"].to(torch.uint8), following
        self._replay.extend(transitions)

    def _iterate(self) -> float:
        loss: Tensor = self._loss(self._replay.sample())["loss"]
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        self._iterations += 1
        if self._iterations % UPDATE_TARGET_EVERY == 0:
            self._follow.step()
        return float(loss.detach())
