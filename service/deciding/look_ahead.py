"""The LLM-free decision: what the edge answers when the LLM is late, wrong or down."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from service.guidance.step_guidance import StepGuidance
from shared.actions import Action
from shared.features import State
from shared.reach import Reach, distances_ahead
from shared.scenario import Scenario


def decide_without_llm(
    state: State, uav: int, scenario: Scenario, reserved: Collection[int], asked: StepGuidance | None = None
) -> Action:
    """One step of look-ahead over every velocity and every sensor heard, free and with a battery.

    Maximises ``U_j min(q_j, packets movable from the new position) + 0.5 v``; a sensor out of reach from there is
    worth nothing, so that the UAV flies on where there is little to collect. A UAV that is not on its scenario's
    trajectory flies an unknown one: then the most urgent sensor in radio range now, at full speed. Among equals,
    the nearest.

    Args:
        asked: what the operator's guidance adds to the worth; velocities that it forbids are never flown.

    Returns:
        sensor ID and velocity in m/s. A reserved sensor only where every sensor is.
    """
    free = ~np.isin(state.ids, list(reserved))
    if not free.any():
        free[:] = True
    distance = distances_ahead(uav, state.position, state.progress_m, state.places, scenario)
    reach = Reach.of(distance, np.where(state.able, state.queue, 0.0), state.urgency, scenario)
    worth = reach.worth if asked is None else reach.worth + asked.worth
    worth = np.where(free, worth - 1e-9 * distance, -np.inf)
    level, row = np.unravel_index(int(worth.argmax()), worth.shape)
    return Action(int(state.ids[row]), int(level))
