"""The planner without learning keeps to its model, and differs from ``mpc`` in nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from lab.experiments.formula_planner import FormulaPlanner
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import rollout
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.world.environment import PipelineWorld

pytestmark = pytest.mark.usefixtures("brief")


def flown(scenario: Scenario, policy: RecedingHorizonPolicy) -> RecedingHorizonPolicy:
    rollout(PipelineWorld(scenario.model_copy(update={"steps": 6})), policy, 3)
    return policy


@pytest.mark.parametrize("scenario", ["shadowed", "windy", "bursty", "faulty", "field"])
def test_nothing_that_it_sees_changes_its_model(scenario: str) -> None:
    belief = flown(SCENARIOS[scenario], FormulaPlanner()).belief
    assert belief.channel.by_formula and belief.drift.none
    assert (belief.arrivals.rate == SCENARIOS[scenario].mean_arrival_rate).all() and belief.arrivals.dispersion == 1.0


def test_the_planner_that_learns_learns_from_the_same_missions() -> None:
    assert not flown(SCENARIOS["shadowed"], RecedingHorizonPolicy()).belief.channel.by_formula
    windy = flown(SCENARIOS["windy"], RecedingHorizonPolicy()).belief
    assert not windy.drift.none and (windy.arrivals.rate != SCENARIOS["windy"].mean_arrival_rate).any()


def test_beacons_still_tell_it_the_queues() -> None:
    belief = flown(SCENARIOS["paper"], FormulaPlanner()).belief
    assert (belief.heard > 0).any() and np.isfinite(belief.base).all()


def test_where_nothing_can_be_learned_it_flies_as_mpc() -> None:
    """One arrival rate for all sensors, and links as the formula has them."""
    certain = SCENARIOS["paper"].model_copy(update={"arrival_rate_min": 6.0, "arrival_rate_max": 6.0, "steps": 1})
    lost = [
        [tally.collected.tolist() for tally in rollout(PipelineWorld(certain), policy, 3)]
        for policy in (RecedingHorizonPolicy(), FormulaPlanner())
    ]
    assert lost[0] == lost[1]
