"""The ways after a plan's horizon: their steps, and plans towards what is beyond the horizon."""

from __future__ import annotations

import numpy as np

from shared.belief.fleet_belief import FleetBelief
from shared.planning.annealing import Annealing
from shared.planning.orders import Guidance, SensorWish
from shared.planning.receding import RecedingHorizon, steps_to
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories


def test_the_way_to_a_sensor_is_counted_in_steps_at_full_speed() -> None:
    good = np.zeros((5, 2), dtype=np.bool_)
    good[[1, 3], 0] = True
    steps = steps_to(good, stride=4, sums=14, fastest=3)
    # Good places at the sums 4 and 12: from 0 it is 4 on, two steps, and from 5 it is 7, three steps.
    assert steps[:13, 0].tolist() == [2, 1, 1, 1, 0, 3, 2, 2, 2, 1, 1, 1, 0]
    assert steps[13, 0] > 1000 and steps[:, 1].min() > 1000


def on_a_lap(sensors: int) -> tuple[RecedingHorizon, FleetBelief, Trajectory]:
    """A planner at step 0, its belief, and the way of its only UAV, which is at the start."""
    world = Scenario(name="lap", sensors=sensors, uavs=1, lap_radius_m=600.0, lap_offset_m=0.0, radio_radius_m=200.0)
    (path,) = trajectories(world)
    belief = FleetBelief(world)
    belief.locate(0, 0, path.at(0.0).tolist(), 0.0)
    planner = RecedingHorizon(world, belief)
    planner.begin(0)
    return planner, belief, path


def test_a_plan_flies_towards_a_full_sensor_beyond_its_horizon() -> None:
    planner, belief, path = on_a_lap(sensors=1)
    # Of the lap's 3770 m the sensor lies 1885 m ahead; a plan reaches 1120 m, and 200 m by radio.
    belief.begin(np.array([0]), np.array([0]), np.array([55.0]), np.array([50.0]))
    belief.places[0] = path.at(path.length_m / 2)
    draft = planner.draft([0])
    assert draft is not None and draft.kept.tolist() == [0]
    found = draft.search()
    assert found.actions[:, 0, 1].sum() > 0.75 * len(found.actions) * draft.problem.scenario.max_velocity
    parked = Annealing(draft.problem).priced(np.array([[[0, 0]]] * len(found.actions)))
    assert parked.expected_loss > found.expected_loss + 5


def test_sensors_beyond_the_horizon_take_no_ones_place_in_a_plan() -> None:
    planner, belief, path = on_a_lap(sensors=90)
    # 35 sensors that the plan reaches, 55 half a lap ahead, which are full.
    full = np.arange(90) >= 35
    belief.places[:] = np.where(full[:, None], path.at(path.length_m / 2), path.at(300.0))
    belief.begin(np.arange(90), np.zeros(90, dtype=np.int64), np.where(full, 60.0, 5.0), np.full(90, 50.0))
    draft = planner.draft([0])
    assert draft is not None
    assert draft.kept[:35].tolist() == list(range(35)) and len(draft.kept) == 40


def test_a_sensor_far_beyond_the_plans_horizon_is_flown_to_for_its_order() -> None:
    """It is 1.7 km ahead of two sensors that lose at most twelve packets a step meanwhile; a late visit costs 20."""
    world = Scenario(
        name="line",
        sensors=3,
        uavs=1,
        steps=1000,
        routes=(((0.0, 0.0), (6000.0, 0.0)),),
        area_m=6000.0,
        arrival_rate_min=6,
        arrival_rate_max=6,
    )
    places = np.array([[500.0, 0.0], [250.0, 0.0], [2300.0, 0.0]])

    def progress_after(steps: int, visit_every: int) -> float:
        belief = FleetBelief(world)
        planner = RecedingHorizon(world, belief)
        planner.guidance = Guidance(sensors=[SensorWish(sensor_id=2, visit_every=visit_every)])
        progress, queue = 300.0, np.full(3, 50.0)
        for step in range(steps):
            belief.advance(step)
            planner.begin(step)
            belief.locate(0, step, (progress, 0.0), progress)
            near = np.flatnonzero(np.abs(places[:, 0] - progress) <= 360.0)
            belief.hear(near, places[near], np.full(len(near), step), queue[near], np.full(len(near), 50.0))
            belief.places[:] = places
            draft = planner.draft([0])
            assert draft is not None
            planner.adopt(draft, draft.search())
            action = planner.action(0)
            assert action is not None
            belief.record_decision(0, step, *action)
            progress += 10.0 * action.velocity
            served = bool(abs(places[action.sensor_id, 0] - progress) <= 360.0)
            queue[action.sensor_id] *= not served
            belief.settle(0, step, not served)
            queue = np.minimum(queue + 6.0, 60.0)
        return progress

    assert progress_after(20, visit_every=10) > 2300.0 - 360.0
    assert progress_after(20, visit_every=900) < 1000.0
