"""The targets of pretraining: a decision's reward, and the velocity that is ranked first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lab.exploration.rollouts import RolloutStep
from shared.world.scenario import Scenario

Target = Literal["return", "immediate"]
Speed = Literal["teacher", "look_ahead"]


@dataclass(frozen=True)
class Reward:
    """The reward of a decision.

    ``return``: minus :func:`fleet_cost`, its mean over ``horizon`` steps with weights ``discount^n``; a mean, so that
    it has the scale of the online updates' r = -c. ``immediate``: that r, the UAV's own cost of one step.
    """

    target: Target = "return"
    horizon: int = 8
    discount: float = 0.9

    def of(self, steps: Sequence[RolloutStep], scenario: Scenario) -> list[float | None]:
        """The reward of each of a UAV's steps, in order; None where the mission ends before the horizon."""
        if self.target == "immediate":
            return [-step.cost for step in steps]
        costs = np.array([fleet_cost(step, scenario) for step in steps])
        weights = self.discount ** np.arange(self.horizon)
        means = np.correlate(costs, weights / weights.sum(), "valid") if len(costs) >= self.horizon else np.empty(0)
        return [*(-means).tolist(), *[None] * (len(costs) - len(means))]


def fleet_cost(step: RolloutStep, scenario: Scenario) -> float:
    """``f + lost / (W I)``: a UAV's failure and its share of the fleet's losses in the step.

    The UAV's own c would teach it to hover, because overflows out of its reach cost it nothing.
    """
    return float(step.failed) + step.fleet_lost / (scenario.queue_capacity * scenario.uavs)
