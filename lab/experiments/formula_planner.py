"""The planner without learning: a study of the benefit of the learned channel, drift and arrivals."""

from __future__ import annotations

from shared.belief.arrivals import Arrivals
from shared.belief.drift import Drift
from shared.belief.fleet_belief import NOTHING_MEASURED, FleetBelief, Measured
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory
from simulator.policies.mpc import RecedingHorizonPolicy


class _MeanArrivals(Arrivals):
    def take(self, ids: IntArray, came: FloatArray, steps: IntArray, at: IntArray) -> None:
        """Every sensor's rate stays the scenario's mean."""


class _NoDrift(Drift):
    def learn(self, path: Trajectory, start_m: float, still_m: float, end_m: float) -> None:
        """A UAV is expected to fly its velocity times the step."""


class _FormulaBelief(FleetBelief):
    """A belief of the beacons' queues and the UAVs' positions, with the formulas' links, rates and drift."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.arrivals = _MeanArrivals(scenario)
        self.drift = _NoDrift()

    def measure(self, uav: int, ids: IntArray, gain_db: FloatArray) -> Measured:
        """A link has the mean path loss, whatever gain was measured."""
        return NOTHING_MEASURED

    def settle(self, uav: int, step: int, failed: bool) -> None:
        """A transfer moves the planned packets, until a beacon reports otherwise."""


class FormulaPlanner(RecedingHorizonPolicy):
    """The planner of ``mpc`` with the model that it starts with: its channel, drift and arrivals never learn."""

    def new_belief(self, scenario: Scenario) -> FleetBelief:
        """A belief that takes no measurement and no outcome."""
        return _FormulaBelief(scenario)
