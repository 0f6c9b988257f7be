"""Plans over links that may fail: what a problem refuses, and what is preferred."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.planning.fleet_problem import FleetProblem, fly
from shared.planning.greedy import look_ahead
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.bound.solver import Budget, least_loss, plan

ENOUGH = Budget(work=20.0)
HORIZON, FASTEST, SENSORS = 2, 2, 2
SUMS = HORIZON * FASTEST + 1


def problem(chance: FloatArray | float = 1.0, packets: int = 40, **changes: Any) -> FleetProblem:
    """One UAV and two full sensors, with links of so many packets from everywhere, which hold by ``chance``."""
    world = Scenario(name="tiny", sensors=SENSORS, uavs=1, steps=HORIZON, max_velocity=FASTEST)
    shape = (1, SUMS, SENSORS)
    made: dict[str, Any] = {
        "scenario": world,
        "trajectories": trajectories(world),
        "progress_m": np.zeros(1),
        "places": np.zeros((SENSORS, 2)),
        "queue": np.array([60, 60]),
        "battery": np.full(SENSORS, 50.0),
        "arrivals": np.full((HORIZON, SENSORS), 20),
        "links": [np.full(shape, packets)],
        "chances": [np.broadcast_to(np.asarray(chance, dtype=np.float64), shape)],
    }
    return FleetProblem(**{**made, **changes})


def actions(*pairs: tuple[int, int]) -> IntArray:
    """One UAV's actions, ``(H, 1, 2)``."""
    return np.array([[pair] for pair in pairs])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("links", [np.zeros((3, SUMS, SENSORS), dtype=np.int64)]),
        ("links", [np.zeros((1, SUMS - 1, SENSORS), dtype=np.int64)]),
        ("links", [np.zeros((1, SUMS, SENSORS + 1), dtype=np.int64)]),
        ("links", [np.zeros((SUMS, SENSORS), dtype=np.int64)]),
        ("links", [np.zeros((1, SUMS, SENSORS), dtype=np.int64)] * 2),
        ("links", [np.full((1, SUMS, SENSORS), 1.5)]),
        ("links", [np.full((1, SUMS, SENSORS), -1)]),
        ("links", None),
        ("chances", [np.ones((1, SUMS, SENSORS + 1))]),
        ("chances", [np.ones((1, SUMS, SENSORS))] * 2),
        ("chances", [np.full((1, SUMS, SENSORS), 1.01)]),
        ("chances", [np.full((1, SUMS, SENSORS), np.nan)]),
    ],
)
def test_tables_that_make_no_sense_name_their_field(field: str, value: Any) -> None:
    # Chances without links name the field that is there.
    with pytest.raises(ValueError, match="^chances" if value is None else f"^{field}"):
        problem(**{field: value})


def test_a_link_that_moves_nothing_is_a_failure() -> None:
    course = fly(problem(packets=0, chances=None), actions((0, 0), (1, 0)))
    assert not course.link.any()
    assert course.lost.sum() == 80


def test_certain_links_of_the_formulas_packets_are_the_formula() -> None:
    formula = problem(links=None, chances=None, places=np.array([[800.0, 500.0], [900.0, 500.0]]))
    links = [formula.packets(0, np.arange(SUMS), 0)[None]]
    tables = problem(links=links, chances=None, places=formula.places)
    for flown in (actions((0, 0), (1, 0)), actions((1, 2), (0, 2))):
        np.testing.assert_array_equal(fly(formula, flown).queue, fly(tables, flown).queue)
        assert fly(formula, flown).lost.sum() == fly(tables, flown).lost.sum()
    assert plan(formula, ENOUGH).lost_packets == plan(tables, ENOUGH).lost_packets


@pytest.mark.parametrize("steps", [1, HORIZON])
def test_links_after_some_actions_are_those_from_there_on(steps: int) -> None:
    whole = problem(links=[np.random.default_rng(0).integers(0, 60, (steps, SUMS + 3, SENSORS))], chances=None)
    one_step: dict[str, Any] = {"arrivals": np.zeros((1, SENSORS), dtype=np.int64), "chances": None}
    rest = problem(links=whole.links_after(actions((0, 2))), **one_step)
    for summed in range(FASTEST + 1):
        ahead = np.array(2 + summed)
        np.testing.assert_array_equal(rest.packets(0, np.array(summed), 0), whole.packets(0, ahead, 1))
    begin = problem(links=whole.links_until(1), **one_step)
    np.testing.assert_array_equal(begin.packets(0, np.array(1), 0), whole.packets(0, np.array(1), 0))


@pytest.mark.parametrize("likely", [0, 1])
def test_a_likely_link_is_preferred_to_an_unlikely_one(likely: int) -> None:
    chances = np.where(np.arange(SENSORS) == likely, 0.95, 0.4)
    assert look_ahead(problem(chances, arrivals=np.full((1, SENSORS), 20)))[0, 0, 0] == likely


def test_uncertain_links_are_refused_where_links_must_be_certain() -> None:
    with pytest.raises(ValueError, match="^chances"):
        plan(problem(0.5), ENOUGH)
    with pytest.raises(ValueError, match="^chances"):
        least_loss(problem(0.5), seconds=2)
