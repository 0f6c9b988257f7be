"""The LLM-free policy: what the edge answers when the LLM is late, wrong or down and there is no plan."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from service.guidance.step_guidance import StepGuidance
from shared.actions import Action
from shared.features import Reach, State


def look_ahead(state: State, reach: Reach, reserved: Collection[int], guidance: StepGuidance | None = None) -> Action:
    """One step of look-ahead over every velocity and every sensor heard, free and with a battery.

    Maximises ``U_j min(q_j, packets movable from the new position) + 0.5 v``; a sensor out of reach from there is
    worth nothing, so that the UAV flies on where there is little to collect. A UAV that is not on its scenario's
    trajectory flies an unknown one: then the most urgent sensor in radio range now, at full speed. Among equals,
    the nearest.

    Args:
        reach: of this state, as :meth:`State.reach_ahead` has it.
        reserved: sensors that other UAVs have in this step.
        guidance: adds to the worth; a velocity that it forbids is never flown.

    Returns:
        sensor ID and velocity in m/s. A reserved sensor only where every sensor is reserved.
    """
    free = ~np.isin(state.ids, list(reserved))
    if not free.any():
        free[:] = True
    worth = reach.worth if guidance is None else reach.worth + guidance.worth
    worth = np.where(free, worth - 1e-9 * reach.links.distance, -np.inf)
    level, row = np.unravel_index(int(worth.argmax()), worth.shape)
    return Action(int(state.ids[row]), int(level))
