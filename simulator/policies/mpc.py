"""Receding-horizon planning: model predictive control as the conventional alternative to an LLM."""

from __future__ import annotations

import numpy as np

from shared.belief.arrivals import Arrivals
from shared.belief.drift import Drift
from shared.belief.fleet_belief import FleetBelief
from shared.belief.gain_measurements import NOTHING_MEASURED, Measured
from shared.planning.receding import Draft, RecedingHorizon
from shared.world.actions import Action
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory
from simulator.policies.reach import longest_unheard
from simulator.world.observation import Observation


class RecedingHorizonPolicy:
    """The planner of :mod:`shared.planning.receding`; every decision of a UAV plans for the whole fleet again.

    Each decision adds the UAV's observation to the fleet's belief, and its action is fixed in the later plans.
    """

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission; the seed is not used."""
        self._scenario = scenario
        self.belief = self.new_belief(scenario)
        self._planner = RecedingHorizon(scenario, self.belief)

    def new_belief(self, scenario: Scenario) -> FleetBelief:
        """The belief that a mission starts with."""
        return FleetBelief(scenario)

    def draft(self, uav: int, taken: frozenset[int]) -> Draft | None:
        """The problem of the plan that decides for a UAV; off the trajectory there is none."""
        return self._planner.draft([uav], taken)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Sensor and velocity."""
        step = int(observation["step"][0])
        self.belief.advance(step)
        self._planner.begin(step)
        self.belief.locate(uav, step, observation["position"].tolist(), float(observation["progress"][0]))
        ids = np.arange(len(observation["queue"]))
        self.belief.hear(
            ids=ids,
            places=observation["sensor_position"],
            beacon=observation["last_heard"],
            queue=observation["queue"],
            battery=observation["battery"],
        )
        fresh = observation["last_heard"] == step
        self.belief.measure(uav, ids[fresh], observation["channel_gain"][fresh])
        action = self._plan_action(uav, taken)
        if action is None:
            action = Action(longest_unheard(observation, taken), self._scenario.max_velocity)
        self.belief.record_decision(uav, step, *action)
        return action

    def learn(self, uav: int, step: int, failed: bool) -> None:
        """Take the outcome of a UAV's decision of a step."""
        self.belief.settle(uav, step, failed)

    def _plan_action(self, uav: int, taken: frozenset[int]) -> Action | None:
        """The plan's action; none off the trajectory, where no plan exists."""
        draft = self.draft(uav, taken)
        if draft is not None:
            self._planner.adopt(draft, draft.search())
        return self._planner.action(uav, taken)


class _MeanArrivals(Arrivals):
    def take(self, ids: IntArray, came: FloatArray, steps: IntArray, at: IntArray) -> None:
        """Every sensor's rate stays the scenario's mean."""


class _NoDrift(Drift):
    def learn(self, path: Trajectory, start_m: float, still_m: float, end_m: float) -> None:
        """A UAV is expected to fly its velocity times the step."""


class _FormulaBelief(FleetBelief):
    """The beacons' queues and the UAVs' positions; links, rates and ways are the formulas'."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.arrivals = _MeanArrivals(scenario)
        self.drift = _NoDrift()

    def measure(self, uav: int, ids: IntArray, gain_db: FloatArray) -> Measured:
        """A link has the mean path loss, whatever gain was measured."""
        return NOTHING_MEASURED

    def settle(self, uav: int, step: int, failed: bool) -> None:
        """A transfer is what was planned, until a beacon says otherwise."""


class FormulaPlanner(RecedingHorizonPolicy):
    """The planner of ``mpc`` with the model that it starts with: its channel, drift and arrivals never learn."""

    def new_belief(self, scenario: Scenario) -> FleetBelief:
        """A belief that takes no measurement and no outcome."""
        return _FormulaBelief(scenario)
