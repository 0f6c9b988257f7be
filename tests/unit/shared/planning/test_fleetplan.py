"""Plans: exact against trying everything, bounds that hold, and what a caller may fix or forbid."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from ortools.sat.python import cp_model

from shared.planning.fleet_problem import FleetProblem, fly
from shared.planning.greedy import look_ahead
from shared.world.channel import IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.bound.solver import Budget, Interrupted, least_loss, plan

ENOUGH = Budget(work=20.0)
ROUTES = (((100.0, 100.0), (900.0, 100.0)), ((100.0, 900.0), (900.0, 900.0), (500.0, 400.0)))


def tiny(seed: int, horizon: int = 3, **changes: Any) -> FleetProblem:
    """Three sensors about to overflow, two UAVs with three velocities, on a small area where links differ."""
    rng = np.random.default_rng(seed)
    defaults: dict[str, Any] = {
        "name": "tiny",
        "sensors": 3,
        "uavs": 2,
        "steps": horizon,
        "max_velocity": 2,
        "step_s": 100.0,
        "packet_bits": 1e7,
    }
    world = Scenario(**{**defaults, **changes})
    paths = trajectories(world)
    return FleetProblem(
        scenario=world,
        trajectories=paths,
        progress_m=rng.uniform(0, 1, world.uavs) * [path.length_m for path in paths],
        places=rng.uniform(100, 900, (world.sensors, 2)),
        queue=rng.integers(40, 61, world.sensors),
        battery=np.full(world.sensors, world.battery_j),
        arrivals=rng.poisson(20.0, (horizon, world.sensors)),
    )


def changed(problem: FleetProblem, **changes: Any) -> FleetProblem:
    return FleetProblem(**{**vars(problem), **changes})


def lost(problem: FleetProblem, actions: IntArray) -> int:
    """The packets that actions lose."""
    return int(fly(problem, actions).lost.sum())


def least_by_trying(problem: FleetProblem) -> int:
    """The least losses of all action sequences, step by step with equal states merged."""
    world, choices = problem.scenario, range(problem.sensors)
    moves = list(itertools.product(choices, range(world.max_velocity + 1)))
    sequences = itertools.product(itertools.product(moves, repeat=problem.uavs), repeat=problem.horizon)
    return min(lost(problem, np.array(actions)) for actions in sequences)


@pytest.mark.parametrize("seed", range(10))
def test_a_plan_is_as_good_as_trying_every_action_sequence(seed: int) -> None:
    problem = tiny(seed, horizon=1 if seed < 5 else 2, uavs=2 if seed < 5 else 1)
    best = least_by_trying(problem)
    found = plan(problem, ENOUGH)
    assert (found.lost_packets, found.lower_bound, found.optimal) == (best, best, True)


def test_where_nothing_gets_through_noise_there_is_still_a_plan() -> None:
    problem = tiny(0, noise_dbm_hz=0.0, bandwidth_hz=1e12)
    found = plan(problem, ENOUGH)
    assert found.optimal and not fly(problem, found.actions).link.any()


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_from_hopeful_links_is_never_above_the_optimum(seed: int) -> None:
    problem = tiny(seed, horizon=4)
    exact = plan(problem, ENOUGH)
    hopeful, cautious = plan(problem, ENOUGH, "hopeful"), plan(problem, ENOUGH, "cautious")
    assert exact.optimal
    assert hopeful.lower_bound <= exact.lost_packets <= min(hopeful.lost_packets, cautious.lost_packets)
    both = least_loss(problem, seconds=60, workers=1)
    assert (both.lost_packets, both.lower_bound, both.optimal) == (exact.lost_packets, exact.lost_packets, True)


def test_the_worlds_differ_in_what_can_be_saved() -> None:
    losses = {plan(tiny(seed, horizon=4), ENOUGH).lost_packets for seed in range(6)}
    assert len(losses) > 3


@pytest.mark.parametrize("battery", [0.0, 1.0, 12.0, 50.0])
def test_a_bound_holds_when_batteries_run_flat(battery: float) -> None:
    problem = tiny(1, horizon=2, uavs=1)
    problem = changed(problem, battery=np.full(3, battery))
    found = plan(problem, ENOUGH)
    best = least_by_trying(problem)
    assert found.lower_bound <= best <= found.lost_packets
    assert fly(problem, found.actions).lost.sum() == found.lost_packets
    if battery == 0.0:
        assert found.lower_bound == best, "a flat battery moves nothing, and the formulation knows it"


def test_a_plan_can_be_flown_on_routes() -> None:
    found = plan(tiny(3, horizon=4, routes=ROUTES), ENOUGH)
    assert found.optimal
    assert set(found.actions[:, :, 1].ravel().tolist()) <= {0, 1, 2}


@pytest.mark.parametrize("given", [{"fixed": {0: np.array([[1, 2]])}}, {"usable": np.ones((4, 3), dtype=np.bool_)}])
def test_given_actions_and_sensors_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(given))}"):
        plan(changed(tiny(4, horizon=4), **given), ENOUGH)


def test_a_hint_that_is_optimal_is_kept() -> None:
    problem = tiny(6, horizon=4)
    best = plan(problem, ENOUGH)
    again = plan(problem, Budget(work=1e-9), hint=best.actions)
    assert again.lost_packets == best.lost_packets


def test_with_no_time_at_all_there_is_still_a_plan_and_a_bound() -> None:
    problem = tiny(7, horizon=6)
    found = plan(problem, Budget(work=1e-9))
    assert found.actions.shape == (6, 2, 2)
    assert found.lower_bound <= plan(problem, ENOUGH).lost_packets <= found.lost_packets


# ---- the greedy start


def test_a_greedy_plan_keeps_what_is_fixed_and_leaves_it_and_what_is_barred_alone() -> None:
    usable = np.ones((4, 3), dtype=np.bool_)
    usable[1, 2] = False
    reported = {0: np.array([[1, 2], [0, 1]])}
    actions = look_ahead(changed(tiny(4, horizon=4, radio_radius_m=900.0), fixed=reported, usable=usable))
    np.testing.assert_array_equal(actions[:2, 0], reported[0])
    assert actions[0, 1, 0] != 1
    assert actions[1, 1, 0] == 1
    assert all(len(set(step)) == 2 for step in actions[:, :, 0].tolist())


@pytest.mark.parametrize("seed", range(4))
def test_a_search_without_time_ends_no_worse_than_the_greedy_plan(seed: int) -> None:
    problem = tiny(seed, horizon=8)
    greedy = lost(problem, look_ahead(problem))
    idle = lost(problem, np.tile([0, 0], (8, 2, 1)))
    found = least_loss(problem, seconds=1e-6, workers=1)
    assert found.lower_bound <= found.lost_packets <= greedy <= idle


def test_ctrl_c_ends_a_search_with_the_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(cp_model.CpSolver, "solve", interrupted)
    problem = tiny(1, horizon=8)
    with pytest.raises(Interrupted) as stopped:
        least_loss(problem, seconds=60, workers=1)
    assert stopped.value.plan.lost_packets == lost(problem, look_ahead(problem))
    assert stopped.value.plan.lower_bound == 0


def test_the_same_problem_gives_the_same_plan() -> None:
    one, two = (plan(tiny(8, horizon=8), Budget(work=0.05)) for _ in range(2))
    np.testing.assert_array_equal(one.actions, two.actions)


@pytest.mark.parametrize(("sensors", "uavs"), [(1, 1), (1, 2), (2, 3)])
def test_fewer_sensors_than_uavs(sensors: int, uavs: int) -> None:
    problem = tiny(9, horizon=1, sensors=sensors, uavs=uavs)
    found = plan(problem, ENOUGH)
    assert found.lower_bound <= least_by_trying(problem) <= found.lost_packets


def test_with_no_sensor_in_reach_everything_that_overflows_is_lost() -> None:
    problem = tiny(1, horizon=4, radio_radius_m=1.0)
    found = plan(problem, ENOUGH)
    over = (problem.queue + problem.arrivals.sum(axis=0) - problem.scenario.queue_capacity).clip(0)
    assert found.lost_packets == found.lower_bound == over.sum()


def test_more_arrivals_than_a_queue_holds_are_lost_whatever_is_done() -> None:
    problem = changed(tiny(1, horizon=2, uavs=1), arrivals=np.full((2, 3), 100))
    found = plan(problem, ENOUGH)
    assert found.lower_bound == found.lost_packets == least_by_trying(problem)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("queue", np.array([1, 0])),
        ("queue", np.array([61, 0, 0])),
        ("queue", np.array([1.5, 0, 0])),
        ("arrivals", np.zeros((0, 3), dtype=np.int64)),
        ("arrivals", np.full((2, 3), -1)),
        ("places", np.zeros((3, 3))),
        ("fixed", {2: np.array([[0, 0]])}),
        ("late", np.zeros((2, 2, 3))),
    ],
)
def test_a_problem_that_makes_no_sense_names_the_field(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{field}"):
        changed(tiny(0), **{field: value})
