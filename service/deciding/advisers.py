"""Advisers of mode ``guided`` that need no LLM: each prefers some sensor-velocity pairs to others.

One of them is the LLM-free policy, :func:`look_ahead`: in every mode it is what the edge answers when the LLM is late,
wrong or down and there is no plan.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.deciding.attended_state import AttendedState
from service.guidance.step_guidance import StepGuidance
from service.learning.trust import PLANNER
from shared.features.augmented_state import Reach, State
from shared.world.channel import FloatArray
from shared.world.step_rule import Action

# In units of the value regression's target, minus the cost.
_VALUE_TEMPERATURE = 0.05
# The probability that an adviser of one action spreads over all actions, so that its logarithm exists.
SMOOTHING = 0.01


@dataclass(frozen=True, slots=True)
class OneAction:
    """Nearly all probability for one action."""

    action: Action

    def probabilities(self, actions: Sequence[Action]) -> FloatArray:
        """0.99 for the action, if it is a candidate, and equal shares of the rest."""
        probabilities = np.full(len(actions), SMOOTHING / len(actions))
        if self.action in actions:
            probabilities[actions.index(self.action)] += 1.0 - SMOOTHING
        return np.asarray(probabilities / probabilities.sum())


@dataclass(frozen=True, slots=True)
class LearnedValues:
    """``softmax((s_j + u_jv - max_v u_jv) / 0.05)``: the likeliest action is the decision of mode ``value``."""

    action: Action
    values: Mapping[int, NDArray[np.float32]]

    def probabilities(self, actions: Sequence[Action]) -> FloatArray:
        """A sensor that attention did not keep scores as low as the lowest."""
        lowest = min((float(levels.min()) for levels in self.values.values()), default=0.0)
        scores = np.array([float(self.values[s][v]) if s in self.values else lowest for s, v in actions])
        weights = np.exp((scores - scores.max()) / _VALUE_TEMPERATURE)
        return np.asarray(weights / weights.sum())


# An adviser's preference in one state. ``action`` is its own proposal, to be among the candidates.
Preference = OneAction | LearnedValues


def _by_plan(state: AttendedState) -> Preference | None:
    """The receding-horizon plan's action, if there is a plan of this step."""
    planner = state.mission.planner
    planned = None if planner is None else planner.action(state.uav_id, state.reserved)
    return None if planned is None else OneAction(planned)


def _by_value(state: AttendedState) -> Preference:
    """The learned values."""
    values = {}
    for velocities, kept in zip(state.values_of_velocities(state.rows), state.candidates, strict=True):
        values[kept.sensor_id] = kept.score + velocities - velocities.max()
    return LearnedValues(state.best_by_value(), values)


def look_ahead(state: State, reach: Reach, reserved: Collection[int], guidance: StepGuidance | None = None) -> Action:
    """One step of look-ahead over every velocity and every sensor heard, free and with a battery.

    Maximises ``U_j min(q_j, packets movable from the new position) + 0.5 v``; a sensor out of reach from there is
    worth nothing, so that the UAV flies on where there is little to collect. A UAV that is not on its scenario's
    trajectory flies an unknown one: then the most urgent sensor in radio range now, at full speed. Among equals,
    the nearest.

    Args:
        reach: of this state, by :meth:`State.reach_ahead`.
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


# By their names in the trust, the response and the metrics, in the order of the response.
ADVISERS: dict[str, Callable[[AttendedState], Preference | None]] = {
    PLANNER: _by_plan,
    "value": _by_value,
    "policy": lambda state: OneAction(look_ahead(state.state, state.reach, state.reserved, state.guidance)),
}
