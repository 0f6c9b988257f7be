"""Advisers of mode ``guided`` that need no LLM: each prefers some sensor-velocity pairs to others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.special import softmax

from service.deciding.attended_state import AttendedState
from service.deciding.look_ahead import decide_without_llm
from service.learning.trust import PLANNER
from service.mission.mission import Mission
from shared.actions import Action
from shared.channel import FloatArray

# In units of the value regression's target, minus the cost.
_VALUE_TEMPERATURE = 0.05
# What an adviser that names one candidate leaves to all together, so that its logarithm exists.
SMOOTHING = 0.01


class Adviser(Protocol):
    """An adviser. ``name`` is its key in the trust, the response and the metrics."""

    name: str

    def proposal(self, mission: Mission, view: AttendedState) -> Action | None:
        """What it would do itself, to be among the candidates; None where it has nothing to say."""
        ...

    def probabilities(self, mission: Mission, view: AttendedState, actions: Sequence[Action]) -> FloatArray:
        """How it would choose among the candidates, ``(n,)``, summing to 1; only where it has a proposal."""
        ...


class PlannerAdviser:
    """The receding-horizon plan, where there is one of this step."""

    name = PLANNER

    def proposal(self, mission: Mission, view: AttendedState) -> Action | None:
        """The plan's action."""
        if mission.planner is None:
            return None
        return mission.planner.action(view.uav_id, mission.reserved(view.step, view.uav_id))

    def probabilities(self, mission: Mission, view: AttendedState, actions: Sequence[Action]) -> FloatArray:
        """Nearly all for the plan's action."""
        return one_hot(self.proposal(mission, view), actions)


class ValueAdviser:
    """The learned values, ``softmax((s_j + u_jv - max_v u_jv) / 0.05)``: likeliest is what mode ``value`` would do."""

    name = "value"

    def proposal(self, mission: Mission, view: AttendedState) -> Action | None:
        """The best-scored sensor and the best velocity for it."""
        return view.by_value(mission)

    def probabilities(self, mission: Mission, view: AttendedState, actions: Sequence[Action]) -> FloatArray:
        """A sensor that attention did not see scores as low as the lowest."""
        values = view.values(mission)
        lowest = min((float(levels.min()) for levels in values.values()), default=0.0)
        scores = np.array([float(values[s][v]) if s in values else lowest for s, v in actions])
        return np.asarray(softmax(scores / _VALUE_TEMPERATURE))


class PolicyAdviser:
    """The LLM-free policy: one step of look-ahead."""

    name = "policy"

    def proposal(self, mission: Mission, view: AttendedState) -> Action | None:
        """Its decision."""
        reserved = mission.reserved(view.step, view.uav_id)
        return decide_without_llm(view.state, view.uav_id, mission.scenario, reserved, view.asked)

    def probabilities(self, mission: Mission, view: AttendedState, actions: Sequence[Action]) -> FloatArray:
        """Nearly all for its decision."""
        return one_hot(self.proposal(mission, view), actions)


# In the order of the response.
ADVISERS: tuple[Adviser, ...] = (PlannerAdviser(), ValueAdviser(), PolicyAdviser())


def one_hot(action: Action | None, actions: Sequence[Action]) -> FloatArray:
    """0.99 for one action, if it is there, and the rest for all alike, ``(n,)``."""
    probabilities = np.full(len(actions), SMOOTHING / len(actions))
    if action in actions:
        probabilities[actions.index(action)] += 1.0 - SMOOTHING
    return np.asarray(probabilities / probabilities.sum())
