"""MADQN as the paper describes it: an independent agent for each UAV, on the plain state.

Ours (:mod:`lab.marl.madqn`) has one network for all UAVs, features that look ahead, and a mask.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lab.marl.madqn import (
    BATCH,
    DISCOUNT,
    EPSILON_END,
    EPSILON_SHARE,
    ITERATIONS_A_STEP,
    LEARNING_RATE,
    REPLAY,
    TAU,
    UPDATE_TARGET_EVERY,
    WARM_UP,
    WORLDS,
)
from lab.marl.networks import INDEPENDENT, IndependentAgents, plain_state, plain_width
from lab.marl.training import Round
from lab.marl.training_worlds import TrainingWorlds, events_of
from shared.world.scenario import Scenario

_FIELDS = ("state", "choice", "reward", "following", "done")


class Replay:
    """The newest transitions of one agent, as tensors in a ring."""

    def __init__(self, capacity: int, width: int) -> None:
        self.filled, self._next = 0, 0
        self.state, self.following = torch.zeros((2, capacity, width))
        self.choice = torch.zeros((capacity, 2), dtype=torch.int64)
        self.reward, self.done = torch.zeros((2, capacity))

    def add(self, **rows: Tensor) -> None:
        """Add n transitions, each field ``(n, ...)``."""
        places = (self._next + torch.arange(len(rows["reward"]))) % len(self.reward)
        for name in _FIELDS:
            getattr(self, name)[places] = rows[name]
        self._next = (self._next + len(places)) % len(self.reward)
        self.filled = min(len(self.reward), self.filled + len(places))

    def sample(self) -> dict[str, Tensor]:
        """A batch, drawn with replacement."""
        rows = torch.randint(self.filled, (BATCH,))
        return {name: getattr(self, name)[rows] for name in _FIELDS}

    def state_dict(self) -> dict[str, Any]:
        """The filled part."""
        return {"next": self._next, **{name: getattr(self, name)[: self.filled].clone() for name in _FIELDS}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self._next, self.filled = state["next"], len(state["reward"])
        for name in _FIELDS:
            getattr(self, name)[: self.filled] = state[name]


class PaperMadqn:
    """Independent deep Q-learning with the paper's table: each UAV has its own networks, replay and optimiser.

    The value of a choice is ``Q(sensor) + Q(velocity)``, one head each. An agent's target is its reward and the
    discounted greatest value of its target network. The reward is minus the paper's P_l, the same for every UAV.
    Nothing is masked, and no agent knows the others' choices.

    Args:
        episodes: missions of the whole training, for the schedule of epsilon and the size of the replay buffers.
        first_seed: of the training worlds.
    """

    name = INDEPENDENT
    worlds = WORLDS

    def __init__(self, scenario: Scenario, episodes: int, first_seed: int) -> None:
        self._scenario, self._next_seed = scenario, first_seed
        self._worlds = TrainingWorlds(scenario)
        self._online, self._target = IndependentAgents(scenario), IndependentAgents(scenario)
        self._target.load_state_dict(self._online.state_dict())
        self._optimisers = [
            torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, fused=True) for agent in self._online.agents
        ]
        capacity = min(REPLAY, episodes * scenario.steps)
        self._replays = [Replay(capacity, plain_width(scenario)) for _ in range(scenario.uavs)]
        self._explored, self._explores = 0, max(1, round(EPSILON_SHARE * episodes / WORLDS * scenario.steps))
        self._iterations = 0

    @property
    def network(self) -> nn.Module:
        """The target networks of all agents."""
        return self._target

    @property
    def epsilon(self) -> float:
        """The share of random choices: from 1 linearly to its end."""
        return 1.0 - (1.0 - EPSILON_END) * min(1.0, self._explored / self._explores)

    def round(self) -> Round:
        """Fly ``worlds`` missions, and learn at each step."""
        scenario, fleet = self._scenario, range(self._scenario.uavs)
        observation = self._worlds.reset(range(self._next_seed, self._next_seed + WORLDS))
        self._next_seed += WORLDS
        before = plain_state(scenario, observation)
        lost, reward, losses = 0.0, 0.0, list[float]()
        for step in range(scenario.steps):
            choices = torch.stack([self._choose(uav, before[:, uav]) for uav in fleet], dim=1)
            self._explored += 1
            flown: NDArray[np.int64] = choices.numpy()
            observation, outcome = self._worlds.step(flown[..., 0], flown[..., 1])
            after = plain_state(scenario, observation)
            rewards = -torch.from_numpy(events_of(outcome))
            over = torch.full((WORLDS,), float(step == scenario.steps - 1))
            for uav, replay in enumerate(self._replays):
                replay.add(
                    state=before[:, uav],
                    choice=choices[:, uav],
                    reward=rewards,
                    following=after[:, uav],
                    done=over,
                )
            lost, reward = lost + float(outcome.lost_packets.mean()), reward + float(rewards.mean())
            # Of a shared buffer that all UAVs fill, an agent's is a share.
            if self._replays[0].filled >= WARM_UP // scenario.uavs:
                losses += [self._iterate() for _ in range(ITERATIONS_A_STEP)]
            before = after
        return Round(loss=sum(losses) / max(1, len(losses)), lost_packets=lost, reward=reward)

    def _choose(self, uav: int, state: Tensor) -> Tensor:
        """Sensor and velocity in each world ``(B, 2)``, each at random with probability epsilon."""
        best = self._online.greedy(uav, state)
        sizes = torch.tensor([self._scenario.sensors, self._scenario.max_velocity + 1])
        drawn = (torch.rand(best.shape) * sizes).long()
        explores = torch.rand((len(best), 1)) < self.epsilon
        return torch.where(explores, drawn, best)

    def _iterate(self) -> float:
        """A gradient step of every agent; returns the mean loss."""
        total = 0.0
        for uav, (replay, optimiser) in enumerate(zip(self._replays, self._optimisers, strict=True)):
            batch = replay.sample()
            heads = self._online(uav, batch["state"])
            value = sum(h.gather(1, batch["choice"][:, [i]])[:, 0] for i, h in enumerate(heads))
            with torch.no_grad():
                coming = sum(head.max(dim=1).values for head in self._target(uav, batch["following"]))
                target = batch["reward"] + DISCOUNT * (1.0 - batch["done"]) * coming
            loss = nn.functional.smooth_l1_loss(value, target)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            total += float(loss.detach())
        self._iterations += 1
        if self._iterations % UPDATE_TARGET_EVERY == 0:
            with torch.no_grad():
                for own, online in zip(self._target.parameters(), self._online.parameters(), strict=True):
                    own.lerp_(online, TAU)
        return total / len(self._replays)

    def state(self) -> dict[str, Any]:
        """The state for ``restore``, without that of the random generator."""
        return {
            "next_seed": self._next_seed,
            "explored": self._explored,
            "iterations": self._iterations,
            "online": self._online.state_dict(),
            "target": self._target.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self._optimisers],
            "replays": [replay.state_dict() for replay in self._replays],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a ``state``."""
        self._next_seed, self._explored, self._iterations = (state[n] for n in ("next_seed", "explored", "iterations"))
        self._online.load_state_dict(state["online"])
        self._target.load_state_dict(state["target"])
        for optimiser, saved in zip(self._optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        for replay, saved in zip(self._replays, state["replays"], strict=True):
            replay.load_state_dict(saved)
