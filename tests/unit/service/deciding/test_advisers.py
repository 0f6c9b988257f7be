import math

import numpy as np
import pytest

from service.deciding.advisers import LearnedValues, look_ahead
from shared.features.augmented_state import State
from shared.world.channel import link_holds
from shared.world.step_rule import Action
from shared.world.trajectory import trajectories
from tests.support.missions import PAPER, attended, mission, uav

X, Y = PAPER.lap_centres[0]
PATH = trajectories(PAPER)[0]
ON_LAP = (X + PAPER.lap_radius_m, Y)


def state(**kwargs: object) -> State:
    return attended(mission(), uav(**kwargs)).state  # type: ignore[arg-type]


def test_the_sensor_is_in_reach_after_the_move() -> None:
    """Far ahead on the lap: out of reach at full speed's opposite, in reach where the policy flies."""
    ahead = PATH.at(480.0)
    view = attended(mission(), uav(position=ON_LAP, x=[float(ahead[0])], y=[float(ahead[1])], queue=[60.0]))
    sensor, velocity = look_ahead(view.state, view.reach, frozenset())
    arrived = PATH.at(velocity * PAPER.step_s)
    assert sensor == 0
    assert velocity > 0
    assert link_holds(math.dist(arrived, ahead), PAPER)
    assert not link_holds(math.dist(ON_LAP, ahead), PAPER)


def test_it_slows_down_for_a_full_queue_that_it_would_leave_behind() -> None:
    behind = PATH.at(-300.0)
    s = state(position=ON_LAP, x=[float(behind[0])], y=[float(behind[1])], queue=[60.0])
    _, velocity = look_ahead(s, s.reach_ahead(0, PAPER), frozenset())
    arrived = PATH.at(velocity * PAPER.step_s)
    assert velocity < PAPER.max_velocity
    assert link_holds(math.dist(arrived, behind), PAPER)


def test_on_an_unknown_trajectory_the_most_urgent_in_range_at_full_speed() -> None:
    s = state(queue=[10.0, 40.0, 50.0, 20.0, 60.0, None])
    assert look_ahead(s, s.reach_ahead(0, PAPER), frozenset()) == (2, 14)
    assert look_ahead(s, s.reach_ahead(0, PAPER), frozenset({2})) == (1, 14)
    # Sensors 4 and 5 are 400 and 500 m away: the nearest free one.
    assert look_ahead(s, s.reach_ahead(0, PAPER), frozenset({0, 1, 2, 3})) == (4, 14)
    assert look_ahead(s, s.reach_ahead(0, PAPER), frozenset(range(6)))[0] == 2


@pytest.mark.parametrize("position", [ON_LAP, (500.0, 500.0)])
def test_an_empty_battery_sends_nothing(position: tuple[float, float]) -> None:
    report = uav(queue=[10.0, 60.0], position=position, x=[position[0] - 50, position[0] - 60])
    report.sensors.battery[1] = 0.0
    s = attended(mission(), report).state
    assert look_ahead(s, s.reach_ahead(0, PAPER), frozenset())[0] == 0


def test_a_sensor_that_attention_dropped_is_as_unlikely_as_the_worst_that_it_kept() -> None:
    values = {2: np.array([0.1, 0.3], dtype=np.float32), 5: np.array([0.0, 0.2], dtype=np.float32)}
    learned = LearnedValues(Action(2, 1), values)
    best, worst, dropped = learned.probabilities([Action(2, 1), Action(5, 0), Action(9, 1)])
    assert best > 100 * worst
    assert dropped == worst
