"""The rollout evaluator's futures over links that the edge has learned: shadowed ones, and a dead radio's."""

from __future__ import annotations

import numpy as np
import pytest

from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState, SampledFutures
from shared.belief.fleet_belief import FleetBelief
from shared.world.channel import FloatArray, channel_gain_db
from shared.world.scenario import SCENARIOS
from shared.world.step_rule import Action

PAPER = SCENARIOS["paper"]
IDS = np.arange(2)
TO_EITHER = [Action(0, 0), Action(1, 0)]


def heard(*excess_db: float) -> FleetBelief:
    """A fleet whose UAV 0 has heard two full sensors as far away as each other, with these excess losses."""
    fleet = FleetBelief(PAPER)
    x, y = (float(metres) for metres in fleet.trajectory(0).at(0.0))
    distance = np.full(2, 50.0)
    for step in range(4):
        fleet.advance(step)
        fleet.locate(0, step, (x, y), 0.0)
        fleet.hear(IDS, np.array([(x, y + 50.0), (x, y - 50.0)]), np.full(2, step), np.full(2, 60.0), np.full(2, 50.0))
        fleet.measure(0, IDS, channel_gain_db(distance, PAPER) - np.array(excess_db))
    return fleet


def lost(fleet: FleetBelief) -> FloatArray:
    return evaluate(RolloutState.of(fleet, PAPER, 3, 0), TO_EITHER).lost


def test_by_the_formula_links_are_certain_and_either_sensor_is_as_good() -> None:
    fleet = heard(0.0, 0.0)
    state = RolloutState.of(fleet, PAPER, 3, 0)
    assert not state.margins
    assert state.alive.tolist() == [1.0, 1.0]
    # Each future draws its arrivals.
    assert abs(np.subtract(*lost(fleet))) < 8.0


def test_a_candidate_over_an_unlikely_link_is_rated_worse() -> None:
    fleet = heard(0.0, 30.0)
    shadowed = evaluate(RolloutState.of(fleet, PAPER, 3, 0), TO_EITHER)
    assert shadowed.lost[1] > shadowed.lost[0] + 3.0
    # The failed transmission is in the step's cost.
    assert shadowed.cost[1] > shadowed.cost[0] + 0.5


@pytest.mark.parametrize("excess_db", [0.0, 3.0])
def test_a_candidate_with_a_dead_radio_is_rated_worse(excess_db: float) -> None:
    fleet = heard(excess_db, excess_db)
    before = lost(fleet)
    for _ in range(3):
        fleet.channel.failures.settle(1, failed=True)
    state = RolloutState.of(fleet, PAPER, 3, 0)
    assert state.alive[1] < 0.2 < 0.8 < state.alive[0]
    dead = evaluate(state, TO_EITHER)
    assert dead.lost[1] > dead.lost[0] + 3.0
    assert dead.cost[1] > dead.cost[0] + 0.5
    assert dead.lost[1] > before[1] + 3.0


def test_the_more_likely_a_link_the_cheaper_the_step() -> None:
    costs = []
    for excess_db in (10.0, 30.0, 31.0):
        fleet = heard(0.0, excess_db)
        costs.append(evaluate(RolloutState.of(fleet, PAPER, 3, 0), TO_EITHER).cost[1])
    assert costs[0] + 0.5 < costs[1] < costs[2]


def test_the_same_state_is_judged_the_same_to_the_bit() -> None:
    fleet, again = heard(2.0, 9.0), FleetBelief(PAPER)
    fleet.channel.failures.settle(1, failed=True)
    again.load_state_dict(fleet.state_dict())
    np.testing.assert_array_equal(lost(fleet), lost(again))


def test_rollouts_begin_with_what_a_burst_brought_since_the_last_beacon() -> None:
    world = SCENARIOS["bursty"].model_copy(update={"queue_capacity": 200})
    fleet = FleetBelief(world)
    here = fleet.trajectory(0).at(0.0)
    fleet.locate(0, 0, here.tolist(), 0.0)
    queue = 0.0
    for step in range(31):
        fleet.hear(np.array([0]), here[None], np.array([step]), np.array([queue]), np.array([50.0]))
        queue += 20.0 if step >= 27 else 3.0
    assert fleet.arrivals.in_bursts
    for step in (30, 31, 32, 34):
        fleet.uavs[0].step = step
        state = RolloutState.of(fleet, world, step, 0)
        row = state.sensors.tolist().index(0)
        start = SampledFutures.of(state, 4000).start[:, row].mean()
        assert start == pytest.approx(fleet.queue(step)[0], abs=1.0)


def test_rollouts_know_that_an_unheard_sensor_was_emptied_in_the_step_before() -> None:
    fleet = FleetBelief(PAPER)
    here = fleet.trajectory(2).at(0.0).tolist()
    fleet.places[3] = here
    fleet.locate(2, 0, here, 0.0)
    fleet.record_decision(2, 0, 3, 0)
    fleet.advance(1)
    fleet.locate(2, 1, here, 0.0)
    state = RolloutState.of(fleet, PAPER, 1, 2)
    row = state.sensors.tolist().index(3)
    assert SampledFutures.of(state, 2000).start[:, row].mean() == pytest.approx(fleet.queue(1)[3], abs=0.5)
