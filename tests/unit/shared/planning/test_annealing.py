"""Simulated annealing makes plans cheaper, within what the problem allows."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from shared.planning import annealing, annealing_costs
from shared.planning.annealing import Annealing, warm_up
from shared.planning.fleet_problem import FleetProblem, Found
from shared.planning.queue_chains import Arriving, QueueChains, queue_chains
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories

HORIZON, FASTEST, SENSORS = 3, 4, 4
SUMS = HORIZON * FASTEST + 1
NOWHERE = SENSORS - 1


def full_chains(uncertain: float = 1.0) -> QueueChains:
    """Three full sensors with twenty packets a step, and one nowhere without packets."""
    mean = np.tile([20.0, 20.0, 20.0, 0.0], (HORIZON, 1))
    later = np.array([[1], [3]]) * mean[:1]
    nothing = np.zeros(SENSORS)
    return queue_chains(
        base=np.array([60.0, 60.0, 60.0, 0.0]),
        base_variance=nothing,
        came=Arriving(nothing, nothing),
        coming=Arriving(mean, mean * uncertain),
        later=Arriving(later, later * uncertain),
        capacity=60,
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
    return problem(chances, stages=stages, **changes)


def random_plan(whole: FleetProblem, seed: int) -> IntArray:
    """Actions with each sensor at most once a step, and the fixed ones first."""
    random = np.random.default_rng([seed, 1])
    actions = np.empty((HORIZON, whole.uavs, 2), dtype=np.int64)
    actions[:, :, 0] = [random.permutation(NOWHERE)[: whole.uavs] for _ in range(HORIZON)]
    actions[:, :, 1] = random.choice(whole.levels, (HORIZON, whole.uavs))
    for uav, fixed in whole.fixed.items():
        actions[: len(fixed), uav] = fixed
    return actions


def loss(whole: FleetProblem, actions: IntArray) -> float:
    """What actions are expected to lose."""
    return Annealing(whole).priced(actions).expected_loss


def searched(whole: FleetProblem, start: IntArray) -> Found:
    """The best plan of some runs."""
    run = Annealing(whole)
    runs = [run.search(start, max(0.1 * loss(whole, start), 0.02), number) for number in range(3)]
    return min(runs, key=lambda found: found.expected_loss)


def cheapest(whole: FleetProblem) -> float:
    """The least expected loss of all actions of one UAV."""
    run = Annealing(whole)
    every = itertools.product(range(NOWHERE), whole.levels.tolist())
    plans = itertools.product(list(every), repeat=HORIZON)
    return min(run.priced(np.array(pairs)[:, None]).expected_loss for pairs in plans)


def drawn_loss(whole: FleetProblem, actions: IntArray, draws: int = 20_000) -> float:
    """The mean loss, with the links, arrivals and queues drawn, of actions whose transfers move whole levels."""
    chains, random = whole.chains, np.random.default_rng(0)
    assert chains is not None and chains.level == 2.0
    total, places = np.zeros(draws), np.arange(chains.start.shape[1])
    flown = np.cumsum(actions[:, :, 1], axis=0)
    stage = len(chains.after) - 1 if whole.stages else 0
    for sensor in range(whole.sensors):
        level = random.choice(places, draws, p=chains.start[sensor] / chains.start[sensor].sum())
        for step in range(whole.horizon):
            served = [u for u in range(whole.uavs) if actions[step, u, 0] == sensor and whole.links is not None]
            for uav in served[:1]:
                chance = whole.chance(uav, flown[step, uav], step)[sensor]
                level = np.where(random.uniform(size=draws) < chance, np.maximum(level - 20, 0), level)
            total += chains.lost[step, sensor][level]
            come = chains.arrive[step, sensor]
            level = np.minimum(level + random.choice(places, draws, p=come / come.sum()), places[-1])
        if whole.stages is not None:
            stage = min(int(whole.stages[u][flown[-1, u], sensor]) for u in range(whole.uavs))
        total += chains.after[stage, sensor][level]
    return float(total.mean())


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_gets_cheaper(seed: int) -> None:
    whole = random_problem(seed)
    start = random_plan(whole, seed)
    found = searched(whole, start)
    assert found.expected_loss < loss(whole, start)
    np.testing.assert_array_equal(found.actions, searched(whole, start).actions)
    for row in found.actions[:, :, 0].tolist():
        served = [sensor for sensor in row if sensor != NOWHERE]
        assert len(set(served)) == len(served)


@pytest.mark.parametrize("seed", range(4))
def test_one_uavs_plan_is_close_to_the_best_of_all(seed: int) -> None:
    allowed = np.array([True, False, True, False, True])
    whole = random_problem(seed, uavs=1, allowed=allowed)
    found, best = searched(whole, random_plan(whole, seed)).expected_loss, cheapest(whole)
    assert best - 1e-3 <= found <= 1.02 * best


@pytest.mark.parametrize("seed", range(20))
def test_the_searchs_cost_is_the_expected_loss_of_its_plan(seed: int) -> None:
    whole = random_problem(seed, uavs=3)
    found = searched(whole, random_plan(whole, seed))
    assert found.expected_loss == pytest.approx(loss(whole, found.actions), abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_expected_loss_is_the_mean_over_links_arrivals_and_queues(seed: int) -> None:
    whole = random_problem(seed)
    actions = random_plan(whole, seed)
    assert loss(whole, actions) == pytest.approx(drawn_loss(whole, actions), rel=0.02)


def test_a_visit_saves_what_its_link_is_likely_to_move() -> None:
    # One visit of chance 0.3 to a full sensor, then none: of the 60 packets that come, 40 more have room if it holds.
    chance = np.zeros((1, SUMS, SENSORS))
    chance[..., 0] = 0.3
    whole = problem([chance], chains=full_chains(0.0))
    actions = np.array([[(0, 0)], [(NOWHERE, 0)], [(NOWHERE, 0)]])
    idle = np.array([[(NOWHERE, 0)]] * 3)
    assert loss(whole, idle) - loss(whole, actions) == pytest.approx(0.3 * 40.0, rel=0.02)


def test_a_uav_goes_to_the_place_with_the_highest_chance() -> None:
    chance = np.zeros((1, SUMS, SENSORS))
    chance[0, 1, 0], chance[0, 3, 0] = 0.2, 0.9
    whole = problem([chance, np.zeros_like(chance)])
    found = searched(whole, np.array([[(0, 1), (1, 0)], [(2, 4), (1, 0)], [(2, 4), (1, 0)]]))
    assert found.actions[0, 0].tolist() == [0, 3]


def test_two_uavs_exchange_their_sensors() -> None:
    # UAV 0 alone reaches sensor 1, and both reach sensor 0, UAV 0 a little better.
    first, second = np.zeros((1, SUMS, SENSORS)), np.zeros((1, SUMS, SENSORS))
    first[..., 0], first[..., 1], second[..., 0] = 0.9, 0.85, 0.8
    found = searched(problem([first, second]), np.tile([[0, 0], [NOWHERE, 0]], (HORIZON, 1, 1))).actions
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
    found, cost = searched(whole, start)
    assert cost == pytest.approx(loss(whole, found), abs=1e-3)
    assert found[0, 0].tolist() == [0, 3]
    assert found[0, 1, 0] not in (0, 1)
    assert set(found[:, 1, 1].tolist()) <= {0, 2, 4}


def test_links_that_change_from_step_to_step_are_used_when_they_hold() -> None:
    chance = np.zeros((HORIZON, SUMS, SENSORS))
    chance[1, :, 2] = 1.0
    links = [np.full((HORIZON, SUMS, SENSORS), 40)]
    found = searched(problem([chance], links=links), np.tile([[NOWHERE, 0]], (HORIZON, 1, 1)))
    assert found.actions[1, 0, 0] == 2


def test_an_overdue_sensor_is_visited_though_it_loses_nothing() -> None:
    # Sensor 2 has the least chance everywhere, and being late there costs 30 packets a step.
    chance = np.zeros((1, SUMS, SENSORS))
    chance[..., :3] = 0.9, 0.8, 0.4
    late = np.zeros((HORIZON + 1, HORIZON + 1, SENSORS))
    late[0, :, 2] = 30.0
    start = np.array([[(0, 0)], [(1, 0)], [(0, 0)]])
    assert 2 not in searched(problem([chance]), start).actions[:1, 0, 0]
    whole = problem([chance], late=late)
    found = searched(whole, start)
    assert found.actions[0, 0, 0] == 2
    assert found.expected_loss == pytest.approx(loss(whole, found.actions), abs=1e-3)
    # Four steps count. Without a visit each costs 30; a visit leaves its link's failure.
    idle = np.tile([[NOWHERE, 0]], (HORIZON, 1, 1))
    once = idle.copy()
    once[1, 0, 0] = 2
    without = loss(problem([chance]), idle) - loss(problem([chance]), once)
    assert loss(whole, idle) - loss(whole, once) - without == pytest.approx(3 * 0.4 * 30.0, rel=1e-3)


def test_without_time_the_velocities_stay_and_the_plan_is_no_worse() -> None:
    whole = random_problem(0)
    start = random_plan(whole, 0)
    run = Annealing(whole)
    at_once = run.search(start, 1.0, until=0.0)
    np.testing.assert_array_equal(at_once.actions[:, :, 1], start[:, :, 1])
    assert at_once.expected_loss <= loss(whole, start)
    assert not np.array_equal(run.search(start, 1.0).actions[:, :, 1], start[:, :, 1])


def test_each_run_draws_other_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.planning.annealing.CHANGES", 20)
    whole = random_problem(0, uavs=3)
    start = random_plan(whole, 0)
    run = Annealing(whole)
    found = [run.search(start, 20.0, number).actions for number in range(2)]
    assert not np.array_equal(found[0], found[1])


def test_a_step_that_saves_nothing_collects_the_most_packets() -> None:
    # Nothing comes, so nothing is lost; sensor 1 has the most packets.
    nothing = np.zeros(SENSORS)
    chains = queue_chains(
        base=np.array([10.0, 40.0, 20.0, 0.0]),
        base_variance=nothing,
        came=Arriving(nothing, nothing),
        coming=Arriving(np.zeros((HORIZON, SENSORS)), np.zeros((HORIZON, SENSORS))),
        later=Arriving(np.zeros((2, SENSORS)), np.zeros((2, SENSORS))),
        capacity=60,
        best_chance=np.ones(SENSORS),
        weights=np.ones(SENSORS),
    )
    chance = np.ones((1, SUMS, SENSORS))
    chance[..., NOWHERE] = 0.0
    found = searched(problem([chance], chains=chains), np.tile([[NOWHERE, 0]], (HORIZON, 1, 1)))
    assert found.actions[:, 0, 0].tolist() == [1, 2, 0]


def test_a_uav_flies_at_full_speed_all_the_way_where_only_that_reaches_a_sensor() -> None:
    # World 562 of `paper`: no single step at full speed gains anything.
    chance = np.zeros((1, SUMS, SENSORS))
    chance[0, -1, 0], chance[0, 2:4, 1] = 1.0, 0.1
    found = searched(problem([chance]), np.tile([[1, 1]], (HORIZON, 1, 1)))
    assert found.actions[:, 0, 1].tolist() == [FASTEST] * HORIZON and found.actions[-1, 0, 0] == 0


def test_every_problem_is_searched_by_the_same_compiled_function() -> None:
    usable = np.ones((HORIZON, SENSORS), dtype=np.bool_)
    late = np.ones((HORIZON + 1, HORIZON + 1, SENSORS))
    links, chances = [np.full((HORIZON, SUMS, SENSORS), 40)], [np.ones((HORIZON, SUMS, SENSORS))]
    warm_up()
    for whole in (
        random_problem(0, usable=usable, late=late, allowed=np.array([True, False, True, False, True])),
        problem(chances, links=links),
    ):
        searched(whole, random_plan(whole, 0))
    functions: list[Any] = [annealing._anneal, annealing._settle, annealing_costs.begin]
    assert [len(function.signatures) for function in functions] == [1, 1, 1]


def test_the_lowest_stage_of_all_uavs_counts() -> None:
    nothing = np.zeros((1, SUMS, SENSORS))
    near, far = (np.full((SUMS, SENSORS), stage) for stage in (0, 1))
    idle = np.tile([[NOWHERE, 0]], (HORIZON, 2, 1))
    lost = [loss(problem([nothing] * 2, stages=list(pair)), idle) for pair in ((near, far), (near, near), (far, far))]
    assert lost[0] == lost[1]
    # Three full sensors, and two more steps of twenty packets.
    assert lost[2] - lost[0] == pytest.approx(3 * 2 * 20.0, rel=1e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {"chains": None},
        {"stages": [np.zeros((SUMS, SENSORS), dtype=np.int64)]},
        {"stages": [np.zeros((SUMS, 1), dtype=np.int64)] * 2},
        {"stages": [np.full((SUMS, SENSORS), 2)] * 2},
        {"stages": [np.full((SUMS, SENSORS), -1)] * 2},
    ],
)
def test_stages_that_make_no_sense_name_their_field(changes: dict[str, Any]) -> None:
    stages = [np.zeros((SUMS, SENSORS), dtype=np.int64)] * 2
    with pytest.raises(ValueError, match=r"^stages"):
        problem([np.zeros((1, SUMS, SENSORS))] * 2, **{"stages": stages, **changes})
