"""What a plan leaves behind: the ways to the sensors, their price, and plans towards what is beyond the horizon."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from shared.fleetplan import Budget, FleetBelief, FleetProblem, RecedingHorizon, plan, price
from shared.fleetplan.afterwards import Afterwards, steps_to
from shared.scenario import Scenario
from shared.trajectory import trajectories
from simulator.flying.true_problem import true_problem
from simulator.world import PipelineWorld

HORIZON, FASTEST, SENSORS, UAVS = 2, 2, 2, 2
SUMS = HORIZON * FASTEST + 1
ENOUGH = Budget(work=20.0)


def problem(**changes: Any) -> FleetProblem:
    """Two UAVs over two sensors that only the second UAV may serve; the way to them shortens as the UAVs fly."""
    world = Scenario(name="tiny", sensors=SENSORS, uavs=UAVS, steps=HORIZON, max_velocity=FASTEST)
    links = np.zeros((UAVS, 1, SUMS, SENSORS), dtype=np.int64)
    links[1, :, 1] = 30
    rising = np.array([0.0, 5.0, 12.0])[:, None, None]
    risk = np.broadcast_to(rising + np.array([9.0, 3.0, 0.0])[:, None], (3, HORIZON + 1, SENSORS)) * [1.0, 2.0]
    stages = [np.clip(np.array([2, 2, 1, 1, 0])[:, None] + [0, 1], 0, 2), np.clip(np.arange(SUMS) - 1, 0, 2)[:, None]]
    made: dict[str, Any] = {
        "scenario": world,
        "trajectories": trajectories(world),
        "progress_m": np.zeros(UAVS),
        "places": np.zeros((SENSORS, 2)),
        "queue": np.array([60, 50]),
        "battery": np.full(SENSORS, 50.0),
        "arrivals": np.full((HORIZON, SENSORS), 8),
        "links": list(links),
        "risk": np.zeros((HORIZON + 1, HORIZON + 1, SENSORS)),
        "afterwards": Afterwards([np.broadcast_to(table, (SUMS, SENSORS)) for table in stages], risk),
    }
    return FleetProblem(**{**made, **changes})


def every(horizon: int) -> Any:
    """All action sequences ``(H, I, 2)``."""
    moves = list(itertools.product(range(SENSORS), range(FASTEST + 1)))
    return (np.array(actions) for actions in itertools.product(itertools.product(moves, repeat=UAVS), repeat=horizon))


@pytest.mark.parametrize("weights", [None, np.array([1.0, 3.0])])
def test_the_search_prices_what_comes_after_as_trying_everything_does(weights: Any) -> None:
    made = problem(weights=weights)
    found = plan(made, ENOUGH, "cautious")
    assert found.status == "OPTIMAL"
    assert price(made, found.actions) == (found.lost_packets, found.objective)
    assert found.objective == pytest.approx(min(price(made, actions)[1] for actions in every(HORIZON)))


def test_the_lowest_stage_of_all_uavs_counts() -> None:
    made = problem()
    still = np.zeros((HORIZON, UAVS, 2), dtype=np.int64)
    far = still.copy()
    far[:, 1, 1] = FASTEST
    # The first UAV is at stages 2 and 2, the second at 0 or at 2. The risk of both sensors is 12 to 14 packets a stage.
    assert made.afterwards is not None
    assert made.afterwards.stage(np.array([0, 0])).tolist() == [0, 0]
    assert made.afterwards.stage(np.array([0, 4])).tolist() == [2, 2]
    assert price(made, far)[1] - price(made, still)[1] == pytest.approx(12.0 + 24.0)


def test_the_way_to_a_sensor_is_counted_in_steps_at_full_speed() -> None:
    good = np.zeros((5, 2), dtype=np.bool_)
    good[[1, 3], 0] = True
    steps = steps_to(good, stride=4, sums=14, fastest=3)
    # Good places at the sums 4 and 12: from 0 it is 4 on, two steps, and from 5 it is 7, three steps.
    assert steps[:13, 0].tolist() == [2, 1, 1, 1, 0, 3, 2, 2, 2, 1, 1, 1, 0]
    assert steps[13, 0] > 1000 and steps[:, 1].min() > 1000


@pytest.mark.parametrize(
    "changes",
    [
        {"risk": None},
        {"afterwards": Afterwards([np.zeros((SUMS, SENSORS), dtype=np.int64)], np.zeros((1, HORIZON + 1, SENSORS)))},
        {"afterwards": Afterwards([np.zeros((SUMS, 1), dtype=np.int64)] * 2, np.zeros((1, HORIZON + 1, SENSORS)))},
        {"afterwards": Afterwards([np.ones((SUMS, SENSORS), dtype=np.int64)] * 2, np.zeros((1, HORIZON + 1, SENSORS)))},
        {"afterwards": Afterwards([np.zeros((SUMS, SENSORS), dtype=np.int64)] * 2, np.zeros((1, HORIZON, SENSORS)))},
    ],
)
def test_tables_that_make_no_sense_name_their_field(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"^afterwards"):
        problem(**changes)


def test_a_plan_flies_towards_a_full_sensor_beyond_its_horizon() -> None:
    world = Scenario(name="lap", sensors=1, uavs=1, lap_radius_m=600.0, lap_offset_m=0.0, radio_radius_m=200.0)
    (path,) = trajectories(world)
    belief = FleetBelief(world)
    planner = RecedingHorizon(world, belief)
    planner.begin(0)
    # Of the lap's 3770 m the sensor lies 1885 m ahead; a plan reaches 1120 m, and 200 m by radio.
    belief.locate(0, 0, path.at(0.0).tolist(), 0.0)
    belief.begin(np.array([0]), np.array([0]), np.array([55.0]), np.array([50.0]))
    belief.places[0] = path.at(path.length_m / 2)
    draft = planner.draft([0])
    assert draft is not None and draft.kept.tolist() == [0]
    found = draft.search()
    assert found.actions[:, 0, 1].sum() > 0.75 * len(found.actions) * world.max_velocity
    parked = np.array([[[0, 0]]] * len(found.actions))
    assert price(draft.problem, parked)[1] > found.objective + 5


def test_sensors_beyond_the_horizon_take_no_ones_place_in_a_plan() -> None:
    world = Scenario(name="lap", sensors=90, uavs=1, lap_radius_m=600.0, lap_offset_m=0.0, radio_radius_m=200.0)
    (path,) = trajectories(world)
    belief = FleetBelief(world)
    planner = RecedingHorizon(world, belief)
    planner.begin(0)
    belief.locate(0, 0, path.at(0.0).tolist(), 0.0)
    # 35 sensors that the plan reaches, 55 half a lap ahead, which are full.
    full = np.arange(90) >= 35
    belief.places[:] = np.where(full[:, None], path.at(path.length_m / 2), path.at(300.0))
    belief.begin(np.arange(90), np.zeros(90, dtype=np.int64), np.where(full, 60.0, 5.0), np.full(90, 50.0))
    draft = planner.draft([0])
    assert draft is not None
    assert draft.kept[:35].tolist() == list(range(35)) and len(draft.kept) == 40


def test_a_bound_has_no_price_of_what_comes_after() -> None:
    world = PipelineWorld()
    world.reset(seed=0)
    assert true_problem(world).afterwards is None
