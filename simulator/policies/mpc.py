"""Receding-horizon planning: model predictive control as the conventional alternative to an LLM."""

import numpy as np

from shared.belief.fleet_belief import FleetBelief
from shared.planning.receding import Draft, RecedingHorizon
from shared.world.scenario import Scenario
from shared.world.step_rule import Action
from simulator.policies.hand_written import longest_unheard
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
