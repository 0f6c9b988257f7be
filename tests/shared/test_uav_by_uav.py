"""Plans over uncertain links are searched UAV by UAV, within what the problem allows."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from shared.channel import FloatArray, IntArray
from shared.fleetplan import FleetProblem
from shared.fleetplan.afterwards import Afterwards
from shared.fleetplan.expected_loss import ExpectedLoss
from shared.fleetplan.queue_chains import Arriving, QueueChains, queue_chains
from shared.fleetplan.uav_by_uav import searched
from shared.scenario import Scenario
from shared.trajectory import trajectories

HORIZON, FASTEST, SENSORS = 3, 4, 4
SUMS = HORIZON * FASTEST + 1
NOWHERE = SENSORS - 1


def full_chains(uncertain: float = 1.0) -> QueueChains:
    """Three full sensors with twenty packets a step, and one nowhere without packets."""
    mean = np.tile([20.0, 20.0, 20.0, 0.0], (HORIZON + 1, 1))
    nothing = np.zeros(SENSORS)
    return queue_chains(
        base=np.array([60.0, 60.0, 60.0, 0.0]),
        base_variance=nothing,
        came=Arriving(nothing, nothing),
        coming=Arriving(mean, mean * uncertain),
        capacity=60,
        beyond=(1, 3),
        best_chance=np.ones(SENSORS),
        weights=np.ones(SENSORS),
    )


def problem(chances: list[FloatArray], **changes: Any) -> FleetProblem:
    """UAVs with links of 40 packets from everywhere, which hold by ``chances``."""
    uavs = len(chances)
    world = Scenario(name="tiny", sensors=NOWHERE, uavs=uavs, steps=HORIZON, max_velocity=FASTEST)
    made: dict[str, Any] = {
        "scenario": world,
        "trajectories": trajectories(world),
        "progress_m": np.zeros(uavs),
        "places": np.zeros((SENSORS, 2)),
        "queue": np.array([60, 60, 60, 0]),
        "battery": np.full(SENSORS, 50.0),
        "arrivals": np.tile([20, 20, 20, 0], (HORIZON, 1)),
        "risk": np.zeros((HORIZON + 1, HORIZON + 1, SENSORS)),
        "links": [np.full((1, SUMS, SENSORS), 40)] * uavs,
        "chances": chances,
        "chains": full_chains(),
    }
    return FleetProblem(**{**made, **changes})


def random_problem(seed: int, uavs: int = 2, **changes: Any) -> FleetProblem:
    """Chances and stages after the horizon that differ from place to place."""
    random = np.random.default_rng(seed)
    chances = [random.uniform(size=(1, SUMS, SENSORS)) for _ in range(uavs)]
    for chance in chances:
        chance[..., NOWHERE] = 0.0
    stages = [random.integers(0, 2, (SUMS, SENSORS)) for _ in range(uavs)]
    after = Afterwards(stages, np.zeros((2, HORIZON + 1, SENSORS)))
    return problem(chances, afterwards=after, **changes)


def random_plan(whole: FleetProblem, seed: int) -> IntArray:
    """Actions with each sensor at most once a step, and the fixed ones first."""
    random = np.random.default_rng([seed, 1])
    actions = np.empty((HORIZON, whole.uavs, 2), dtype=np.int64)
    actions[:, :, 0] = [random.permutation(NOWHERE)[: whole.uavs] for _ in range(HORIZON)]
    actions[:, :, 1] = random.choice(whole.levels, (HORIZON, whole.uavs))
    for uav, fixed in whole.fixed.items():
        actions[: len(fixed), uav] = fixed
    return actions


def cheapest(whole: FleetProblem) -> float:
    """The least expected loss of all actions of one UAV."""
    loss = ExpectedLoss(whole)
    every = itertools.product(range(NOWHERE), whole.levels.tolist())
    plans = itertools.product(list(every), repeat=HORIZON)
    return min(loss.of(np.array(pairs)[:, None]) for pairs in plans)


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_gets_cheaper(seed: int) -> None:
    whole = random_problem(seed)
    start = random_plan(whole, seed)
    found, cost = searched(ExpectedLoss(whole), [start])
    assert cost < ExpectedLoss(whole).of(start)
    np.testing.assert_array_equal(found, searched(ExpectedLoss(whole), [start])[0])
    for row in found[:, :, 0].tolist():
        served = [sensor for sensor in row if sensor != NOWHERE]
        assert len(set(served)) == len(served)


@pytest.mark.parametrize("seed", range(4))
def test_one_uavs_plan_is_close_to_the_best_of_all(seed: int) -> None:
    allowed = np.array([True, False, True, False, True])
    whole = random_problem(seed, uavs=1, allowed=allowed)
    (_, found), best = searched(ExpectedLoss(whole), [random_plan(whole, seed)]), cheapest(whole)
    assert best - 1e-3 <= found <= 1.1 * best


@pytest.mark.parametrize("seed", range(20))
def test_the_searchs_cost_is_the_expected_loss_of_its_plan(seed: int) -> None:
    whole = random_problem(seed, uavs=3)
    found, cost = searched(ExpectedLoss(whole), [random_plan(whole, seed), random_plan(whole, seed + 50)])
    assert cost == pytest.approx(ExpectedLoss(whole).of(found), abs=1e-3)


def test_the_search_begins_with_the_best_start() -> None:
    whole = random_problem(3)
    plans = sorted((random_plan(whole, seed) for seed in range(6)), key=ExpectedLoss(whole).of)
    np.testing.assert_array_equal(searched(ExpectedLoss(whole), plans[::-1], -1.0)[0], plans[0])


def test_the_expected_loss_is_the_mean_over_links() -> None:
    # One visit of chance 0.3 to a full sensor, then none: of the 60 packets that come, 40 more have room if it holds.
    chance = np.zeros((1, SUMS, SENSORS))
    chance[..., 0] = 0.3
    whole = problem([chance], chains=full_chains(0.0))
    actions = np.array([[(0, 0)], [(NOWHERE, 0)], [(NOWHERE, 0)]])
    idle = np.array([[(NOWHERE, 0)]] * 3)
    loss = ExpectedLoss(whole)
    assert loss.of(idle) - loss.of(actions) == pytest.approx(0.3 * 40.0, rel=0.02)


def test_a_uav_goes_to_the_place_with_the_highest_chance() -> None:
    chance = np.zeros((1, SUMS, SENSORS))
    chance[0, 1, 0], chance[0, 3, 0] = 0.2, 0.9
    whole = problem([chance, np.zeros_like(chance)])
    found, _ = searched(ExpectedLoss(whole), [np.array([[(0, 1), (1, 0)], [(2, 4), (1, 0)], [(2, 4), (1, 0)]])])
    assert found[0, 0].tolist() == [0, 3]


def test_two_uavs_exchange_their_sensors() -> None:
    # UAV 0 alone reaches sensor 1, and both reach sensor 0, UAV 0 a little better.
    first, second = np.zeros((1, SUMS, SENSORS)), np.zeros((1, SUMS, SENSORS))
    first[..., 0], first[..., 1], second[..., 0] = 0.9, 0.85, 0.8
    found, _ = searched(ExpectedLoss(problem([first, second])), [np.tile([[0, 0], [NOWHERE, 0]], (HORIZON, 1, 1))])
    assert found[:, 0, 0].tolist().count(1) == HORIZON
    assert found[:, 1, 0].tolist().count(0) == HORIZON


@pytest.mark.parametrize("seed", range(5))
def test_fixed_actions_reserved_sensors_and_forbidden_velocities_stay(seed: int) -> None:
    usable = np.ones((HORIZON, SENSORS), dtype=np.bool_)
    usable[0, 1] = False
    allowed = np.array([True, False, True, False, True])
    whole = random_problem(seed, fixed={0: np.array([(0, 3)])}, usable=usable, allowed=allowed)
    start = random_plan(whole, seed)
    start[0, 1, 0] = 2
    found, cost = searched(ExpectedLoss(whole), [start])
    assert cost == pytest.approx(ExpectedLoss(whole).of(found), abs=1e-3)
    assert found[0, 0].tolist() == [0, 3]
    assert found[0, 1, 0] not in (0, 1)
    assert set(found[:, 1, 1].tolist()) <= {0, 2, 4}


def test_an_overdue_sensor_is_visited_though_it_loses_nothing() -> None:
    # Sensor 2 has the least chance everywhere, and being late there costs 30 packets a step.
    chance = np.zeros((1, SUMS, SENSORS))
    chance[..., :3] = 0.9, 0.8, 0.4
    late = np.zeros((HORIZON + 1, HORIZON + 1, SENSORS))
    late[0, :, 2] = 30.0
    start = np.array([[(0, 0)], [(1, 0)], [(0, 0)]])
    assert 2 not in searched(ExpectedLoss(problem([chance])), [start])[0][:1, 0, 0]
    found, cost = searched(ExpectedLoss(problem([chance], late=late)), [start])
    assert found[0, 0, 0] == 2
    loss = ExpectedLoss(problem([chance], late=late))
    assert cost == loss.of(found) < loss.of(start)


def test_without_time_the_plan_stays() -> None:
    whole = random_problem(0)
    start = random_plan(whole, 0)
    np.testing.assert_array_equal(searched(ExpectedLoss(whole), [start], -1.0)[0], start)
    assert not np.array_equal(searched(ExpectedLoss(whole), [start], math.inf)[0], start)
