"""The rollout evaluator's initial state: its horizon, and what other UAVs have decided in the same step."""

from __future__ import annotations

import numpy as np
import pytest

from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState
from shared.belief.fleet_belief import FleetBelief
from shared.planning.orders import Guidance, SensorWish
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.step_rule import Action

PAPER = SCENARIOS["paper"]
CAPACITY = float(PAPER.queue_capacity)


def fleet(step: int = 4, battery: tuple[float, float] = (50.0, 50.0)) -> FleetBelief:
    """UAV 0 has two full sensors near its start, heard in this step; UAV 1 is on its own lap, far from both."""
    belief = FleetBelief(PAPER)
    belief.advance(step)
    x, y = belief.trajectory(0).at(0.0).tolist()
    for uav in range(2):
        belief.locate(uav, step, tuple(belief.trajectory(uav).at(0.0).tolist()), 0.0)
    places = np.array([(x, y + 30.0), (x, y - 30.0)])
    belief.hear(np.arange(2), places, np.full(2, step), np.full(2, CAPACITY), np.array(battery))
    return belief


@pytest.mark.parametrize(
    ("step", "horizon"), [(0, 8), (PAPER.steps - 3, 3), (PAPER.steps - 1, 1), (PAPER.steps, 8), (PAPER.steps + 5, 8)]
)
def test_the_horizon_ends_with_the_scenario_and_is_whole_again_for_a_fleet_that_flies_on(
    step: int, horizon: int
) -> None:
    assert RolloutState.of(fleet(step), PAPER, step, 0).horizon == horizon


def test_a_visit_that_another_uav_has_decided_counts_where_its_link_is_likely() -> None:
    belief = fleet()
    belief.record_decision(0, 4, 1, 0)
    state = RolloutState.of(belief, PAPER, 4, 1)
    assert state.visited[1] == 4
    row = state.sensors.tolist().index(1)
    assert (state.queue[row], state.age[row]) == (0.0, 0)


def test_a_visit_that_another_uav_has_decided_out_of_its_reach_counts_for_nothing() -> None:
    belief = fleet()
    before = RolloutState.of(belief, PAPER, 4, 0)
    belief.record_decision(1, 4, 1, 0)
    state = RolloutState.of(belief, PAPER, 4, 0)
    assert state.decided == {1: 0}
    assert state.visited[1] == before.visited[1] < 4
    assert state.queue.tolist() == before.queue.tolist() == [CAPACITY, CAPACITY]


def test_a_sensor_with_a_flat_battery_has_no_packets_to_lose() -> None:
    state = RolloutState.of(fleet(battery=(50.0, 0.0)), PAPER, 4, 0)
    assert state.queue.tolist() == [CAPACITY, 0.0]
    assert not state.unknown.any()


def test_a_candidate_whose_sensor_another_uav_has_reserved_fails() -> None:
    judged = evaluate(RolloutState.of(fleet(), PAPER, 4, 0, reserved={1}), [Action(0, 0), Action(1, 0)])
    assert judged.cost[1] >= 1.0 > judged.cost[0]


def crowded(sensors: int = 80) -> tuple[FleetBelief, Scenario]:
    """UAV 0 among more sensors than are simulated; the first is nearly empty and the others are full."""
    scenario = PAPER.model_copy(update={"sensors": sensors})
    belief = FleetBelief(scenario)
    belief.advance(4)
    x, y = belief.trajectory(0).at(0.0).tolist()
    belief.locate(0, 4, (x, y), 0.0)
    places = np.array([(x + 0.5 * n, y) for n in range(sensors)])
    queue = np.full(sensors, CAPACITY)
    queue[0] = 0.0
    belief.hear(np.arange(sensors), places, np.full(sensors, 4), queue, np.full(sensors, 50.0))
    return belief, scenario


def test_of_too_many_sensors_those_with_a_visit_order_are_simulated_first() -> None:
    belief, scenario = crowded()
    ordered = Guidance(sensors=[SensorWish(sensor_id=0, visit_every=3)])
    without = RolloutState.of(belief, scenario, 4, 0).sensors.tolist()
    found = RolloutState.of(belief, scenario, 4, 0, guidance=ordered).sensors.tolist()
    assert len(without) == len(found) == 64
    assert 0 not in without
    assert 0 in found


def test_many_candidates_are_evaluated_in_one_future_at_least() -> None:
    belief, scenario = crowded()
    state = RolloutState.of(belief, scenario, 4, 0)
    every = [Action(sensor, velocity) for sensor in range(80) for velocity in range(scenario.max_velocity + 1)]
    judged = evaluate(state, 3 * every)
    assert len(judged.lost) == 3 * len(every)
    assert np.isfinite(judged.lost).all() and np.isfinite(judged.cost).all()


@pytest.mark.parametrize(("uavs", "simulated"), [(2, 2), (5, 5), (12, 10)])
def test_up_to_ten_uavs_are_simulated(uavs: int, simulated: int) -> None:
    scenario = PAPER.model_copy(update={"uavs": uavs})
    belief = FleetBelief(scenario)
    belief.advance(4)
    for uav in range(uavs):
        belief.locate(uav, 4, tuple(belief.trajectory(uav).at(0.0).tolist()), 0.0)
    state = RolloutState.of(belief, scenario, 4, 1)
    assert 1 in state.links
    assert len(state.links) == simulated
