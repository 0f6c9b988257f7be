"""What confirmed guidance asks of one UAV's next step: velocities that it may fly, and what its sensors are worth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray, link_holds
from shared.features import State
from shared.guidance import Guidance
from shared.reach import Reach
from shared.scenario import Scenario


@dataclass(frozen=True, slots=True)
class StepGuidance:
    """V velocity levels, J sensors in the order of the state.

    Attributes:
        allowed: shape ``(V,)``, the levels that may be flown.
        due: shape ``(V, J)``, whether the sensor must be visited in this step to be on time, and is in reach then.
        worth: shape ``(V, J)``, packets on top of the LLM-free policy's: ``(w_j - 1) U_j packets``, and W where due,
            which is more than anything else in reach. ``-inf`` where the level is not allowed.
    """

    allowed: NDArray[np.bool_]
    due: NDArray[np.bool_]
    worth: FloatArray

    @classmethod
    def of(
        cls, guidance: Guidance, state: State, reach: Reach, step: int, visits: NDArray[np.int64], scenario: Scenario
    ) -> Self:
        """Of a UAV's state and its reach at a step.

        Args:
            visits: step of each sensor's last visit, by sensor ID; -1 for never.
        """
        allowed = guidance.allowed(scenario.max_velocity + 1)
        overdue = guidance.overdue(step, visits)[state.ids] > 0
        due = overdue & state.able & link_holds(reach.distance, scenario) & allowed[:, None]
        weights = guidance.weights(scenario.sensors)[state.ids]
        worth = (weights - 1.0) * state.urgency * reach.packets + scenario.queue_capacity * due
        return cls(allowed, due, np.where(allowed[:, None], worth, -np.inf))

    def nearest(self, row: int, level: int) -> int:
        """The level to fly at for the sensor in that row, where another was wanted: the nearest that may be flown.

        Where the sensor is due, of those that reach it in time. Nearest rather than best: values of levels were learned
        with all of them, and without the fast ones a UAV that is told the best of the rest hovers.
        """
        choices = np.flatnonzero(self.due[:, row] if self.due[:, row].any() else self.allowed)
        return int(choices[np.abs(choices - level).argmin()])
