"""Checks of the fleet's actions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from shared.world.channel import IntArray
from shared.world.scenario import Scenario


def checked_actions(actions: Mapping[str, ArrayLike], agents: Mapping[str, int], scenario: Scenario) -> IntArray:
    """The actions of all agents as ``(I, 2)`` integers: sensor, velocity; zeros for UAVs that have departed.

    ``agents`` has the UAV of each live agent.

    Raises:
        ValueError: an agent is unknown or has no action, or an action is not two integers within their bounds.
    """
    for agent in actions:
        if agent not in agents:
            raise ValueError(f"{agent}: no such agent")
    limits = (("sensor", scenario.sensors - 1), ("velocity", scenario.max_velocity))
    chosen = np.zeros((scenario.uavs, 2), dtype=np.int64)
    for agent, uav in agents.items():
        if agent not in actions:
            raise ValueError(f"{agent}: no action")
        action = np.asarray(actions[agent])
        if action.shape != (2,) or action.dtype.kind not in "iu":
            raise ValueError(f"{agent}: action {actions[agent]!r} is not two integers (sensor, velocity)")
        for value, (name, last) in zip(action.tolist(), limits, strict=True):
            if not 0 <= value <= last:
                raise ValueError(f"{agent}: {name} {value} is not in 0..{last}")
        chosen[uav] = action
    return chosen
