"""The LLM-free decision: what the edge answers when the LLM is late, wrong or down."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from service.features import State
from shared.channel import link_holds
from shared.scenario import Scenario


def decide_by_urgency(state: State, scenario: Scenario, reserved: Collection[int]) -> tuple[int, int]:
    """The most urgent sensor that will surely be in reach, at the fastest velocity that keeps it there.

    Flying d metres brings the UAV at most d metres farther from any sensor, so a sensor ``m`` metres inside
    the radio radius stays in reach at ``floor(m / step)`` m/s whatever the trajectory. Where no sensor
    qualifies, the UAV makes for the nearest unreserved one at full speed.

    Returns:
        sensor ID and velocity in m/s. A reserved sensor only where every sensor is.
    """
    free = np.array([i not in reserved for i in state.ids.tolist()])
    if not free.any():
        free[:] = True
    sure = free & state.heard & (state.battery > 0) & link_holds(state.distance, scenario)
    if not sure.any():
        nearest = np.where(free, state.distance, np.inf).argmin()
        return int(state.ids[nearest]), scenario.max_velocity
    row = int(np.where(sure, state.urgency, -np.inf).argmax())
    margin = scenario.radio_radius_m - float(state.distance[row])
    return int(state.ids[row]), min(scenario.max_velocity, int(margin / scenario.step_s))
