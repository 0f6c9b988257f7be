"""A recorded mission in the states of the edge: what is known at each decision."""

from __future__ import annotations

from itertools import groupby

from lab.exploration.exploration import explore
from lab.exploration.rollouts import RolloutStep
from lab.training.recorded_states import recorded_states
from service.config.settings import Settings
from service.mission.mission import Mission
from shared.wire.schemas import MissionSpec
from shared.world.scenario import SCENARIOS, Scenario

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 8})


def mission(scenario: Scenario) -> Mission:
    return Mission("test", MissionSpec(scenario=scenario, planner="off"), Settings(mode="value"))


def since_visits(steps: list[RolloutStep], scenario: Scenario) -> list[list[float]]:
    return [state.state.since_visit.tolist() for _, state in recorded_states(mission(scenario), steps)]


def test_an_outcome_is_known_from_the_uavs_next_report_on() -> None:
    steps = list(explore(SHORT, 60_000))
    first, last = 3 * SHORT.uavs, 4 * SHORT.uavs
    other = [step.model_copy(update={"failed": not step.failed}) for step in steps[first:last]]
    seen = since_visits(steps, SHORT)
    seen_otherwise = since_visits([*steps[:first], *other, *steps[last:]], SHORT)
    assert seen[:last] == seen_otherwise[:last]
    assert seen[last] != seen_otherwise[last]


def test_the_state_has_the_links_that_the_fleet_has_learned() -> None:
    scenario = SCENARIOS["shadowed"].model_copy(update={"steps": 8})
    states = [state.state for _, state in recorded_states(mission(scenario), explore(scenario, 60_000))]
    by_formula = [state.channel is None or state.channel.by_formula for state in states]
    # The mission has one channel, which has learned by the end.
    assert not any(by_formula)
    holds = [state.reach.links.margin is not None for state in states if state.reach is not None]
    assert len(holds) == len(states)
    assert all(holds[SHORT.uavs :])


def test_every_decision_is_there_once_in_order() -> None:
    steps = list(explore(SHORT, 60_001))
    found = list(recorded_states(mission(SHORT), steps))
    assert [step for step, _ in found] == steps
    assert [(state.uav_id, state.step) for _, state in found] == [(s.request.uav_id, s.request.step) for s in steps]
    assert all(len(list(group)) == SHORT.uavs for _, group in groupby(steps, key=lambda step: step.request.step))
