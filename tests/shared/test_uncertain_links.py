"""Plans over links that may fail: what a problem refuses, what a flight is expected to move, and what is preferred."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.channel import FloatArray, IntArray
from shared.fleetplan import Budget, FleetProblem, fly, least_loss, look_ahead, plan, price
from shared.scenario import Scenario
from shared.trajectory import trajectories

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


def test_an_uncertain_link_moves_its_expected_packets() -> None:
    course = fly(problem(np.array([0.5, 1.0])), actions((0, 0), (1, 0)))
    assert course.queue[1].tolist() == [60, 60]
    assert course.lost.tolist() == [[0, 20], [20, 0]]
    assert course.link.tolist() == [[40], [40]]
    assert course.chance.tolist() == [[0.5], [1.0]]


def test_a_link_that_moves_nothing_is_a_failure() -> None:
    course = fly(problem(packets=0), actions((0, 0), (1, 0)))
    assert not course.link.any() and not course.chance.any()
    assert course.lost.sum() == 80


def test_a_sensor_probably_visited_keeps_the_rest_of_its_risk() -> None:
    risk = np.zeros((HORIZON + 1, HORIZON + 1, SENSORS))
    risk[0, :, 0] = 10.0
    emptied: dict[str, Any] = {
        "queue": np.array([0, 0]),
        "arrivals": np.zeros((HORIZON, SENSORS), dtype=np.int64),
        "risk": risk,
    }
    costs = [price(problem(chance, **emptied), actions((0, 0), (1, 0)))[1] for chance in (0.0, 0.3, 1.0)]
    assert costs == pytest.approx([30.0, 21.0, 0.0])
    # A second visit cancels as much again.
    assert price(problem(0.3, **emptied), actions((0, 0), (0, 0)))[1] == pytest.approx(7.0 + 4.0 + 4.0)


@pytest.mark.parametrize("chances", [None, [np.ones((1, SUMS, SENSORS))]])
def test_certain_links_of_the_formulas_packets_are_the_formula(chances: Any) -> None:
    formula = problem(links=None, chances=None, places=np.array([[800.0, 500.0], [900.0, 500.0]]))
    links = [formula.packets(0, np.arange(SUMS), 0)[None]]
    tables = problem(links=links, chances=chances, places=formula.places)
    for flown in (actions((0, 0), (1, 0)), actions((1, 2), (0, 2))):
        np.testing.assert_array_equal(fly(formula, flown).queue, fly(tables, flown).queue)
        assert price(formula, flown) == price(tables, flown)
    assert plan(formula, ENOUGH).objective == plan(tables, ENOUGH).objective


@pytest.mark.parametrize("steps", [1, HORIZON])
def test_tables_after_some_actions_are_those_from_there_on(steps: int) -> None:
    random = np.random.default_rng(0)
    shape = (steps, SUMS + 3, SENSORS)
    whole = problem(links=[random.integers(0, 60, shape)], chances=[random.uniform(size=shape)])
    rest = problem(1.0, 40, arrivals=np.zeros((1, SENSORS), dtype=np.int64), **whole.tables_after(actions((0, 2))))
    for summed in range(FASTEST + 1):
        ahead = np.array(2 + summed)
        np.testing.assert_array_equal(rest.packets(0, np.array(summed), 0), whole.packets(0, ahead, 1))
        np.testing.assert_array_equal(rest.chance(0, np.array(summed), 0), whole.chance(0, ahead, 1))
    begin = problem(1.0, 40, arrivals=np.zeros((1, SENSORS), dtype=np.int64), **whole.tables_until(1))
    np.testing.assert_array_equal(begin.chance(0, np.array(1), 0), whole.chance(0, np.array(1), 0))


@pytest.mark.parametrize("likely", [0, 1])
def test_a_likely_link_is_preferred_to_an_unlikely_one(likely: int) -> None:
    chances = np.where(np.arange(SENSORS) == likely, 0.95, 0.4)
    one_step = problem(chances, arrivals=np.full((1, SENSORS), 20))
    for links in ("exact", "cautious"):
        assert plan(one_step, ENOUGH, links).actions[0, 0, 0] == likely
    assert look_ahead(one_step)[0, 0, 0] == likely


def test_the_place_of_the_likelier_link_is_flown_to() -> None:
    chances = np.full((1, SUMS, SENSORS), 0.4)
    chances[0, 2] = 0.95
    found = plan(problem(chances=[chances], arrivals=np.full((1, SENSORS), 20)), ENOUGH)
    assert found.actions[0, 0, 1] == 2


def test_a_link_that_will_hardly_ever_hold_is_not_planned_on() -> None:
    found = plan(problem(np.array([0.9, 0.1])), ENOUGH)
    assert (fly(problem(np.array([0.9, 0.1])), found.actions).chance != 0.1).all()


def test_fixed_actions_over_unlikely_links_are_kept() -> None:
    unlikely = problem(np.array([0.9, 0.0]), fixed={0: np.array([[1, 0]])})
    found = plan(unlikely, ENOUGH, "cautious")
    assert found.actions[0, 0].tolist() == [1, 0]
    assert found.actions[1, 0, 0] == 0


def test_a_whole_missions_search_takes_uncertain_links_too() -> None:
    steps = 12
    shape = (1, steps * FASTEST + 1, SENSORS)
    long = problem(arrivals=np.full((steps, SENSORS), 9), links=[np.full(shape, 40)], chances=[np.full(shape, 0.9)])
    found = least_loss(long, seconds=2, workers=1)
    assert found.actions.shape == (steps, 1, 2)
