"""Confirmed guidance for one UAV's next step: the allowed velocities, and the worth of each sensor."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.features.augmented_state import Reach, State
from shared.planning.orders import Guidance
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario


@dataclass(frozen=True, slots=True)
class StepGuidance:
    """Guidance for V velocity levels and J sensors, in the order of the state.

    Attributes:
        allowed: shape ``(V,)``, whether the operator allows the level.
        due: shape ``(V, J)``, whether a visit of the sensor is due in this step, and the level brings it in reach.
        worth: shape ``(V, J)``, packets to add to the LLM-free policy's worth: ``(w_j - 1) U_j packets``, plus W where
            due, which exceeds the worth of everything else in reach. ``-inf`` if the level is not allowed.
    """

    allowed: NDArray[np.bool_]
    due: NDArray[np.bool_]
    worth: FloatArray

    @classmethod
    def of(
        cls, guidance: Guidance, state: State, reach: Reach, step: int, visits: NDArray[np.int64], scenario: Scenario
    ) -> Self:
        """The guidance for a UAV's state and reach at a step.

        Args:
            visits: the step of each sensor's last visit, by sensor ID; -1 for never.
        """
        allowed = guidance.allowed(scenario.max_velocity + 1)
        due = (guidance.overdue(step, visits)[state.ids] > 0) & state.able & reach.likely & allowed[:, None]
        weights = guidance.weights(scenario.sensors)[state.ids]
        worth = (weights - 1.0) * state.urgency * reach.packets + scenario.queue_capacity * due
        return cls(allowed, due, np.where(allowed[:, None], worth, -np.inf))

    def nearest(self, row: int, level: int) -> int:
        """The allowed level nearest to the given one, for the sensor in that row.

        Where the sensor is due, only levels that bring it in reach count. The nearest level is taken, not the best one:
        the values of levels were learned with all levels, and the best of only the slow ones makes a UAV hover.
        """
        choices = np.flatnonzero(self.due[:, row] if self.due[:, row].any() else self.allowed)
        return int(choices[np.abs(choices - level).argmin()])
