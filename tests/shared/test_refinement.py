"""Plans over uncertain links are improved by exchanges of single actions, within what the problem allows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from shared.channel import FloatArray, IntArray
from shared.fleetplan import FleetProblem, Plan, price
from shared.fleetplan.refinement import refined
from shared.scenario import Scenario
from shared.trajectory import trajectories

HORIZON, FASTEST, SENSORS, UAVS = 3, 4, 3, 2
SUMS = HORIZON * FASTEST + 1


def problem(chances: list[FloatArray], **changes: Any) -> FleetProblem:
    """Two UAVs and three full sensors, with links of 40 packets from everywhere, which hold by ``chances``."""
    world = Scenario(name="tiny", sensors=SENSORS, uavs=UAVS, steps=HORIZON, max_velocity=FASTEST)
    made: dict[str, Any] = {
        "scenario": world,
        "trajectories": trajectories(world),
        "progress_m": np.zeros(UAVS),
        "places": np.zeros((SENSORS, 2)),
        "queue": np.full(SENSORS, 60),
        "battery": np.full(SENSORS, 50.0),
        "arrivals": np.full((HORIZON, SENSORS), 20),
        "links": [np.full((1, SUMS, SENSORS), 40)] * UAVS,
        "chances": chances,
    }
    return FleetProblem(**{**made, **changes})


def random_problem(seed: int, **changes: Any) -> FleetProblem:
    """Chances that differ from place to place."""
    random = np.random.default_rng(seed)
    return problem([random.uniform(size=(1, SUMS, SENSORS)) for _ in range(UAVS)], **changes)


def planned(whole: FleetProblem, actions: IntArray) -> Plan:
    """The actions as a search's plan."""
    return Plan(actions, *price(whole, actions), 0.0, "FEASIBLE", 0.0, 0.0)


def random_plan(whole: FleetProblem, seed: int) -> Plan:
    """Actions with each sensor at most once a step, and the fixed ones first."""
    random = np.random.default_rng([seed, 1])
    actions = np.empty((HORIZON, UAVS, 2), dtype=np.int64)
    actions[:, :, 0] = [random.permutation(SENSORS)[:UAVS] for _ in range(HORIZON)]
    actions[:, :, 1] = random.choice(whole.levels, (HORIZON, UAVS))
    for uav, fixed in whole.fixed.items():
        actions[: len(fixed), uav] = fixed
    return planned(whole, actions)


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_gets_cheaper_and_its_price_is_the_problems(seed: int) -> None:
    whole = random_problem(seed)
    start = random_plan(whole, seed)
    found = refined(whole, start)
    assert found.objective < start.objective
    assert (found.lost_packets, found.objective) == price(whole, found.actions)
    assert all(len(set(row)) == UAVS for row in found.actions[:, :, 0].tolist())


def test_a_uav_goes_to_the_place_with_the_highest_chance_and_is_then_where_it_was_to_be() -> None:
    # At sum 3 the link to sensor 0 holds, elsewhere hardly; the plan collects from sum 1 and is at sum 5 after.
    chance = np.full((1, SUMS, SENSORS), 0.0)
    chance[0, 1, 0], chance[0, 3, 0] = 0.2, 0.9
    whole = problem([chance, np.zeros_like(chance)])
    actions = np.array([[(0, 1), (1, 0)], [(2, 4), (1, 0)], [(2, 4), (1, 0)]])
    found = refined(whole, planned(whole, actions))
    assert found.actions[0, 0].tolist() == [0, 3]
    assert found.actions[:2, 0, 1].sum() == 5


@pytest.mark.parametrize("seed", range(5))
def test_fixed_actions_reserved_sensors_and_forbidden_velocities_stay(seed: int) -> None:
    usable = np.ones((HORIZON, SENSORS), dtype=np.bool_)
    usable[0, 1] = False
    allowed = np.array([True, False, True, False, True])
    whole = random_problem(seed, fixed={0: np.array([(0, 3)])}, usable=usable, allowed=allowed)
    start = random_plan(whole, seed)
    start.actions[0, 1, 0] = 2
    found = refined(whole, planned(whole, start.actions))
    assert found.actions[0, 0].tolist() == [0, 3]
    assert found.actions[0, 1, 0] != 1
    assert set(found.actions[:, 1, 1].tolist()) <= {0, 2, 4}


def test_without_time_the_plan_stays() -> None:
    whole = random_problem(0)
    start = random_plan(whole, 0)
    np.testing.assert_array_equal(refined(whole, start, -1.0).actions, start.actions)
    assert refined(whole, start, math.inf).objective < start.objective
