"""The batch of worlds as a TorchRL environment, for training."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, MultiCategorical, Unbounded
from torchrl.envs import EnvBase

from lab.marl.network_inputs import fleet_input, width
from lab.marl.training_worlds import TrainingWorlds, events_of, state_of
from shared.world.scenario import Scenario
from simulator.world.observation import Observation


class PipelineEnv(EnvBase):  # type: ignore[misc]
    """B training worlds that fly together; world n of a training is drawn from seed ``first_seed + n``.

    Keys, with the UAVs along the second dimension:

    | key | shape, type | meaning |
    |---|---|---|
    | ``agents, observation`` | ``(B, I, F)`` float32 | each UAV's, by :func:`lab.marl.network_inputs.actor_input` |
    | ``agents, action_mask`` | ``(B, I, J + V)`` bool | the slots and velocities allowed |
    | ``agents, action`` | ``(B, I, 2)`` int64 | slot of the sensor in the UAV's own order, velocity in m/s |
    | ``agents, reward`` | ``(B, I, 1)`` float32 | minus the paper's P_l of the step |
    | ``state`` | ``(B, 1 + 2 I + 4 J)`` float32 | the true state, for a critic |
    | ``lost_packets`` | ``(B, 1)`` float32 | of the step, for the learning curve |

    At step T a mission is done and terminated, not truncated: later losses are no part of its loss, and the observation
    has the step.
    """

    batch_locked = True

    def __init__(self, scenario: Scenario, worlds: int, first_seed: int) -> None:
        super().__init__(device="cpu", batch_size=[worlds])
        self.next_seed = first_seed
        self._world = TrainingWorlds(scenario)
        self._order: NDArray[np.int64]
        uavs, choices = scenario.uavs, [scenario.sensors, scenario.max_velocity + 1]
        team = (worlds, uavs)

        def of_agents(**specs: Any) -> Composite:
            return Composite(agents=Composite(specs, shape=team), shape=(worlds,))

        self.observation_spec = of_agents(
            observation=Unbounded((*team, width(scenario))),
            action_mask=Binary(shape=(*team, sum(choices)), dtype=torch.bool),
        )
        self.observation_spec["state"] = Unbounded((worlds, 1 + 2 * uavs + 4 * scenario.sensors))
        self.observation_spec["lost_packets"] = Unbounded((worlds, 1))
        self.action_spec = of_agents(action=MultiCategorical(choices, shape=(*team, 2)))
        self.reward_spec = of_agents(reward=Unbounded((*team, 1)))
        flags = {name: Binary(shape=(worlds, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=(worlds,))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        worlds = self.batch_size[0]
        observation = self._world.reset(range(self.next_seed, self.next_seed + worlds))
        self.next_seed += worlds
        return self._tensors(observation, np.zeros(worlds))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["agents", "action"].numpy()
        sensors = np.take_along_axis(self._order, action[..., :1], axis=-1)[..., 0]
        observation, outcome = self._world.step(sensors, action[..., 1])
        tensors = self._tensors(observation, outcome.lost_packets)
        loss = torch.from_numpy(events_of(outcome))
        tensors["agents", "reward"] = -loss[:, None, None].expand(*action.shape[:2], 1)
        return tensors

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.next_seed = seed

    def _tensors(self, observation: Observation, lost: NDArray[Any]) -> TensorDict:
        views = fleet_input(self._world.scenario, observation)
        self._order = views.order
        over = torch.full((*self.batch_size, 1), self._world.steps_flown == self._world.scenario.steps)
        agents = {"observation": torch.from_numpy(views.features), "action_mask": torch.from_numpy(views.mask)}
        return TensorDict(
            {
                "agents": TensorDict(agents, views.order.shape[:2]),
                "state": torch.from_numpy(state_of(self._world)),
                "lost_packets": torch.from_numpy(lost.astype(np.float32)[:, None]),
                "done": over,
                "terminated": over.clone(),
                "truncated": torch.zeros_like(over),
            },
            self.batch_size,
        )
