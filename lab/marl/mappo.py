"""MAPPO: decentralised actors trained with a critic that sees the true state, with TorchRL's loss and estimator."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, constraints
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.objectives.multiagent import MAPPOLoss

from lab.marl.env import PipelineEnv
from lab.marl.network_inputs import width
from lab.marl.networks import NEVER, trunk, two_heads
from lab.marl.training import Round
from shared.world.scenario import Scenario

# The paper's table.
DISCOUNT = 0.99
LEARNING_RATE = 3e-4
CLIP = 0.2
ENTROPY = 0.01
VALUE = 0.5
EPOCHS = 4
# Not in the paper's table.
EPISODES = 21_600
WORLDS = 40
DECAY_ROUNDS = 40
MINIBATCHES = 4
LAMBDA = 0.9
REWARD_SCALE = 0.1
GRADIENT_NORM = 0.5


class SlotAndVelocity(Distribution):
    """A pair of independent categorical choices, ``(..., 2)``, from concatenated logits ``(..., J + V)``.

    Args:
        mask: the choices allowed, of the logits' shape.
        velocities: V.
    """

    arg_constraints: dict[str, constraints.Constraint] = {}

    def __init__(self, logits: Tensor, mask: Tensor, velocities: int) -> None:
        allowed = torch.where(mask, logits, NEVER)
        sides = allowed[..., :-velocities], allowed[..., -velocities:]
        self._parts = [Categorical(logits=side, validate_args=False) for side in sides]
        super().__init__(logits.shape[:-1], torch.Size([2]), validate_args=False)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """A random pair of choices."""
        return torch.stack([part.sample(sample_shape) for part in self._parts], -1)  # type: ignore[no-untyped-call]

    def log_prob(self, value: Tensor) -> Tensor:
        """The joint log-probability of both choices, ``(...)``."""
        slot, velocity = self._parts
        both: Tensor = slot.log_prob(value[..., 0]) + velocity.log_prob(value[..., 1])  # type: ignore[no-untyped-call]
        return both

    def entropy(self) -> Tensor:
        """The joint entropy of both choices, ``(...)``."""
        return torch.stack([part.entropy() for part in self._parts]).sum(0)  # type: ignore[no-untyped-call]

    @property
    def mode(self) -> Tensor:
        """The most probable pair of choices."""
        return torch.stack([part.logits.argmax(-1) for part in self._parts], -1)


class Critic(nn.Module):
    """The value of the true state for each UAV, ``(..., I, 1)``, from the state and the UAV's observation."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self.value = trunk(1 + 2 * scenario.uavs + 4 * scenario.sensors + width(scenario), 1)

    def forward(self, state: Tensor, observation: Tensor) -> Tensor:
        """``state`` ``(..., S)`` and ``observation`` ``(..., I, F)``."""
        everywhere = state.unsqueeze(-2).expand(*observation.shape[:-1], state.shape[-1])
        value: Tensor = self.value(torch.cat((everywhere, observation), dim=-1))
        return value


class Mappo:
    """Proximal policy optimisation with one actor network for all UAVs and one centralised critic.

    A round flies ``worlds`` missions with actions drawn by the actors, then trains for 4 epochs over them in
    minibatches. Only the critic sees the true state, and only in training. The reward is minus the paper's P_l, the
    same for every UAV. The learning rate is the table's until the last 40 rounds, in which it falls linearly to zero.

    Args:
        episodes: missions of the whole training.
        first_seed: of the training worlds.
    """

    name = "mappo"
    worlds = WORLDS

    def __init__(self, scenario: Scenario, episodes: int, first_seed: int) -> None:
        self._steps = scenario.steps
        self._last_seed = first_seed + episodes
        self._decay_rounds = min(DECAY_ROUNDS, max(1, episodes // WORLDS))
        self._env = PipelineEnv(scenario, WORLDS, first_seed)
        self.network = two_heads(scenario)
        # With small last weights, the first draws are almost uniform whatever the features.
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        nn.init.orthogonal_(last.weight, 0.01)
        nn.init.zeros_(last.bias)
        self._actor = ProbabilisticTensorDictSequential(
            TensorDictModule(self.network, in_keys=[("agents", "observation")], out_keys=[("agents", "logits")]),
            ProbabilisticTensorDictModule(
                in_keys={"logits": ("agents", "logits"), "mask": ("agents", "action_mask")},
                out_keys=[("agents", "action")],
                distribution_class=SlotAndVelocity,
                distribution_kwargs={"velocities": scenario.max_velocity + 1},
                # The library's default is the most probable choice, which explores nothing.
                default_interaction_type=InteractionType.RANDOM,
                return_log_prob=True,
                log_prob_key=("agents", "action_log_prob"),
            ),
        )
        critic = TensorDictModule(
            Critic(scenario), in_keys=["state", ("agents", "observation")], out_keys=[("agents", "state_value")]
        )
        self._loss = MAPPOLoss(
            self._actor, critic, clip_epsilon=CLIP, entropy_coeff=ENTROPY, critic_coeff=VALUE, normalize_advantage=True
        )
        names = {"value": "state_value", "sample_log_prob": "action_log_prob"}
        names |= {name: name for name in ("action", "reward", "done", "terminated")}
        self._loss.set_keys(**{key: ("agents", name) for key, name in names.items()})
        self._loss.make_value_estimator(gamma=DISCOUNT, lmbda=LAMBDA)
        self._optimiser = torch.optim.Adam(self._loss.parameters(), lr=LEARNING_RATE)
        decisions = WORLDS * scenario.steps
        self._buffer = ReplayBuffer(
            storage=LazyTensorStorage(decisions),
            sampler=SamplerWithoutReplacement(),
            batch_size=max(1, decisions // MINIBATCHES),
        )

    def round(self) -> Round:
        """Fly ``worlds`` missions, then learn from them."""
        rounds_left = (self._last_seed - self._env.next_seed) // WORLDS
        self._optimiser.param_groups[0]["lr"] = LEARNING_RATE * min(1.0, rounds_left / self._decay_rounds)
        with torch.no_grad():
            flown = self._env.rollout(self._steps, self._actor, break_when_any_done=False)
            reward = flown["next", "agents", "reward"]
            lost = float(flown["next", "lost_packets"].sum()) / WORLDS
            mission_return = float(reward.mean(dim=-2).sum()) / WORLDS
            flown["next", "agents", "reward"] = reward * REWARD_SCALE
            for flag in ("done", "terminated"):
                flown["next", "agents", flag] = flown["next", flag].unsqueeze(-2).expand(reward.shape)
            self._loss.value_estimator(
                flown,
                params=self._loss.critic_network_params,
                target_params=self._loss.target_critic_network_params,
            )
        self._buffer.empty()
        self._buffer.extend(flown.reshape(-1))
        losses = [self._iterate(batch) for _ in range(EPOCHS) for batch in self._buffer]
        return Round(loss=sum(losses) / len(losses), lost_packets=lost, reward=mission_return)

    def state(self) -> dict[str, Any]:
        """The state for ``restore``, without that of the random generator."""
        return {
            "next_seed": self._env.next_seed,
            "loss": self._loss.state_dict(),
            "optimiser": self._optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a ``state``."""
        self._env.next_seed = state["next_seed"]
        self._loss.load_state_dict(state["loss"])
        self._optimiser.load_state_dict(state["optimiser"])

    def _iterate(self, batch: TensorDict) -> float:
        parts = self._loss(batch)
        loss: Tensor = parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._loss.parameters(), GRADIENT_NORM)
        self._optimiser.step()
        return float(loss.detach())
