"""An edge's decisions without HTTP: a mission in this process, with the service's own state, attention and learner.

A flight takes a tenth of a second of one core. Each outcome trains the modules after the decision that reports it, as
at an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from service.config.settings import Settings
from service.deciding.advisers import look_ahead
from service.deciding.attended_state import AttendedState
from service.learning.modules import Sample
from service.mission.mission import Mission
from shared.wire.schemas import DecideRequest, MissionSpec, Outcome
from shared.wire.sensor_arrays import arrays_of
from shared.world.scenario import Scenario
from shared.world.step_rule import Action
from simulator.world.observation import Observation, decide_request


@cache
def _settings() -> Settings:
    return Settings(store="none", llm_adapter="off")


@dataclass(frozen=True)
class EdgeDecider:
    """The decider at the edge: mode ``value``, or look-ahead in the LLM's place.

    Attributes:
        by: ``value``, the learned values; ``look_ahead``, one step of look-ahead among the sensors that attention
            keeps, as an LLM in mode ``llm`` may name only these.
        spec: of the mission, besides its scenario and seed.
    """

    by: Literal["value", "look_ahead"]
    spec: dict[str, Any]


def look_ahead_among(state: AttendedState) -> Action:
    """The best sensor and velocity by one step of look-ahead among the sensors kept; among all if none is kept."""
    if not state.rows:
        return look_ahead(state.state, state.reach, state.reserved, state.guidance)
    worth = (state.reach.worth - 1e-9 * state.reach.links.distance)[:, state.rows]
    level, place = np.unravel_index(int(worth.argmax()), worth.shape)
    return Action(state.kept_ids[int(place)], int(level))


class EdgeFleet:
    """A fleet with one mission of the service, decided by ``decider``; ``state`` is that of the last decision."""

    state: AttendedState

    def __init__(self, decider: EdgeDecider, scenario: Scenario, seed: int) -> None:
        mode = "value" if decider.by == "value" else "policy"
        spec = MissionSpec.model_validate(
            {"mode": mode, "planner": "off", **decider.spec, "scenario": scenario, "seed": seed}
        )
        self._decider = decider
        self.mission = Mission("claims-map", spec, _settings())
        # Without attention look-ahead does not depend on the weights.
        self._learns = self.mission.uses_attention
        self._made = 0
        self._open: dict[int, tuple[str, float, bool]] = {}
        self._decision: dict[int, str] = {}

    def decide(self, uav: int, observation: Observation) -> Action:
        """The UAV's decision; the mission first takes the outcome of its last one, and learns from it afterwards."""
        mission, learned = self.mission, list[tuple[Sample, float]]()
        request = decide_request(uav, observation, mission.mission_id)
        if uav in self._open:
            decision_id, cost, failed = self._open.pop(uav)
            sample = mission.apply(Outcome(decision_id=decision_id, cost=cost, failed=failed))
            if sample is not None and self._learns:
                learned.append((sample, cost))
        self.observe(request)
        self.state = state = AttendedState.of(mission, request, request.step)
        by_value = self._decider.by == "value" and state.rows
        action = state.best_by_value() if by_value else look_ahead_among(state)
        if action.sensor_id in state.reserved:
            free = (i for i in range(mission.scenario.sensors) if i not in state.reserved)
            action = Action(next(free, action.sensor_id), action.velocity)
        decision_id = f"{self._made:032x}"
        self._made += 1
        mission.commit(state.pending(decision_id, action))
        self._decision[uav] = decision_id
        for sample, cost in learned:
            mission.learn(sample, cost)
        return action

    def observe(self, request: DecideRequest) -> None:
        """As ``Mission.observe``; without the belief where states have each UAV's own reports and do not read it."""
        if self.mission.belief_source == "fleet":
            self.mission.observe(request, request.step)
            return
        columns = arrays_of(request.sensors)
        self.mission.records.hear(columns.ids, columns.beacon, columns.queue)
        self.mission.reservations.attempt(request.step, request.uav_id)

    def take(self, uav: int, cost: float, failed: bool) -> None:
        """Keep the outcome for the UAV's next report."""
        self._open[uav] = (self._decision[uav], cost, failed)
