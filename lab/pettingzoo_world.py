"""The simulated world as a PettingZoo environment, for learning policies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv  # type: ignore[import-untyped]

from lab.marl.training_worlds import state_of
from shared.world.channel import path_loss_db
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.trajectory import Trajectory, trajectories
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Info, Observation
from simulator.world.truth import LARGEST_ERROR, LOSS_BOUNDS_DB, mean_only


class PettingZooWorld(PipelineWorld, ParallelEnv[str, Observation, NDArray[np.int64]]):  # type: ignore[misc]
    """:class:`PipelineWorld` as a ``ParallelEnv`` with spaces and an action mask.

    ``info["action_mask"]``: flat int8, J entries for the sensors (1 for those heard at least once; all 1 if none was)
    followed by ``max_velocity + 1`` ones.

    Args:
        cost: ``default``: the reward is :class:`PipelineWorld`'s. ``paper``: it is minus the paper's P_l of the step,
            the sum of all f and all g, the same for every UAV.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "pipeline_v0", "render_modes": []}
    render_mode: str | None = None

    def __init__(
        self, scenario: Scenario = SCENARIOS["paper"], *, cost: Literal["default", "paper"] = "default"
    ) -> None:
        super().__init__(scenario)
        self.cost = cost
        self.state_space = spaces.Box(-np.inf, np.inf, (1 + 2 * scenario.uavs + 4 * scenario.sensors,), np.float32)
        self._spaces = dict(
            zip(self.possible_agents, (_space(scenario, path) for path in trajectories(scenario)), strict=True)
        )
        self._actions = spaces.MultiDiscrete([scenario.sensors, scenario.max_velocity + 1])

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """As :meth:`PipelineWorld.reset`."""
        observations, infos = super().reset(seed, options)
        return observations, self._masked(observations, infos)

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """As :meth:`PipelineWorld.step`."""
        observations, rewards, terminations, truncations, infos = super().step(actions)
        if self.cost == "paper":
            rewards = dict.fromkeys(rewards, -float(self.tally[-1].events))
        return observations, rewards, terminations, truncations, self._masked(observations, infos)

    def _masked(self, observations: dict[str, Observation], infos: dict[str, Info]) -> dict[str, Info]:
        """The infos with the action masks."""
        velocities = np.ones(self.scenario.max_velocity + 1, dtype=np.int8)
        masks = {}
        for agent, observation in observations.items():
            heard = observation["last_heard"] >= 0
            masks[agent] = np.append(heard | ~heard.any(), velocities).astype(np.int8)
        return {agent: cast(Info, {**info, "action_mask": masks[agent]}) for agent, info in infos.items()}

    def state(self) -> NDArray[np.float32]:
        """The true state for centralised critics, as :func:`~lab.marl.training_worlds.state_of` lays it out."""
        return np.asarray(state_of(self._worlds)[0])

    def observation_space(self, agent: str) -> spaces.Dict:
        """The agent's observation space; the trajectories, hence the bounds of ``position``, differ between agents."""
        return self._spaces[agent]

    def action_space(self, agent: str) -> spaces.MultiDiscrete:
        """The agent's action space."""
        return self._actions


def _space(scenario: Scenario, path: Trajectory) -> spaces.Dict:
    """The observation space of a UAV on that trajectory."""
    count = scenario.sensors
    quietest, loudest = _gain_bounds(scenario) if mean_only(scenario) else (-LOSS_BOUNDS_DB[1], -LOSS_BOUNDS_DB[0])
    # The wind carries a UAV at most twice as far as still air would let it fly.
    stretch = 2.0 if scenario.wind_mps or scenario.gust_mps else 1.0
    farthest = path.length_m + stretch * scenario.steps * scenario.max_velocity * scenario.step_s
    # Rounding may put a circle's point slightly past its bounds.
    margin = 1e-6 + LARGEST_ERROR * scenario.position_noise_m
    lowest, highest = path.bounds

    def column(low: float, high: float) -> spaces.Box:
        return spaces.Box(low, high, (count,), np.float64)

    return spaces.Dict(
        {
            "step": spaces.Box(0, scenario.steps, (1,), np.int64),
            "position": spaces.Box(lowest - margin, highest + margin, dtype=np.float64),
            "progress": spaces.Box(0.0, farthest, (1,), np.float64),
            "sensor_position": spaces.Box(0.0, scenario.area_m, (count, 2), np.float64),
            "queue": column(0.0, float(scenario.queue_capacity)),
            "battery": column(0.0, scenario.battery_j),
            "channel_gain": column(quietest, loudest),
            "last_heard": spaces.Box(-1, scenario.steps, (count,), np.int64),
        }
    )


def _gain_bounds(scenario: Scenario) -> tuple[float, float]:
    """Bounds of the mean gain within the radio radius, dB, whichever of the two excess losses is larger.

    The margin of 1e-6 dB covers the rounding of the sum. 0 is always within the bounds, since it marks a sensor never
    heard.
    """
    excess = (scenario.los_excess_db, scenario.nlos_excess_db)
    free_space = scenario.model_copy(update={"los_excess_db": 0.0, "nlos_excess_db": 0.0})
    nearest, farthest = path_loss_db([0.0, scenario.radio_radius_m], free_space)
    return min(0.0, -farthest - max(excess) - 1e-6), max(0.0, -nearest - min(excess) + 1e-6)
