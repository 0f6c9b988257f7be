"""The LLM-free decision: what the edge answers when the LLM is late, wrong or down."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from service.features import State
from shared.channel import packets_per_step
from shared.scenario import Scenario
from shared.trajectory import progress_of, trajectories

# What a metre a second is worth in urgent packets: a UAV that dwells on little lets the rest of its way overflow.
# On 30 worlds of scenario `paper`, 0.5 to 4 lost 54 to 61 packets, differences within their noise.
_VELOCITY_BONUS = 0.5


def decide_without_llm(state: State, uav: int, scenario: Scenario, reserved: Collection[int]) -> tuple[int, int]:
    """One step of look-ahead over every velocity and every sensor heard, free and with a battery.

    Maximises ``U_j min(q_j, packets movable from the new position) + 0.5 v``; a sensor out of reach from there is
    worth nothing, so that the UAV flies on where there is little to collect. A UAV that is not on its scenario's
    trajectory flies an unknown one: then the most urgent sensor in radio range now, at full speed. Among equals,
    the nearest.

    Returns:
        sensor ID and velocity in m/s. A reserved sensor only where every sensor is.
    """
    free = ~np.isin(state.ids, list(reserved))
    if not free.any():
        free[:] = True
    velocities = np.arange(scenario.max_velocity + 1)
    path = trajectories(scenario)[uav]
    progress = progress_of(path, state.position, state.progress_m)
    if progress is not None:
        ahead = path.at(progress + velocities * scenario.step_s)
        distance = np.linalg.norm(state.places[None] - ahead[:, None], axis=2)
    else:
        velocities, distance = velocities[-1:], state.distance[None]
    able = free & state.heard & (state.battery > 0)
    packets = np.where(able, np.minimum(state.queue, packets_per_step(distance, scenario)), 0.0)
    worth = state.urgency * packets + _VELOCITY_BONUS * velocities[:, None]
    worth = np.where(free, worth - 1e-9 * distance, -np.inf)
    level, row = np.unravel_index(int(worth.argmax()), worth.shape)
    return int(state.ids[row]), int(velocities[level])
