import math

import numpy as np
import pytest

from service.policy import decide_by_urgency
from shared.channel import link_holds
from tests.service.making import PAPER, attended, mission, uav


@pytest.mark.parametrize("x", [500.0, 650.0, 750.0, 820.0, 855.0])
def test_the_sensor_stays_in_reach_wherever_the_uav_flies(x: float) -> None:
    state = attended(mission(), uav(x=[x], queue=[50.0])).state
    sensor, velocity = decide_by_urgency(state, PAPER, frozenset())
    assert sensor == 0
    away = [
        math.hypot(x - 500 - velocity * PAPER.step_s * math.cos(a), velocity * PAPER.step_s * math.sin(a))
        for a in np.linspace(0, 2 * math.pi, 73)
    ]
    assert link_holds(away, PAPER).all()


def test_the_most_urgent_in_reach_and_free() -> None:
    m = mission()
    state = attended(m, uav(queue=[10.0, 40.0, 50.0, 20.0, 60.0, None])).state
    assert decide_by_urgency(state, PAPER, frozenset()) == (2, 14)
    assert decide_by_urgency(state, PAPER, frozenset({2}))[0] == 1
    # Sensors 4 and 5 are 400 and 500 m away: the nearest free one, at full speed.
    assert decide_by_urgency(state, PAPER, frozenset({0, 1, 2, 3})) == (4, 14)
    assert decide_by_urgency(state, PAPER, frozenset(range(6)))[0] == 2


def test_an_empty_battery_sends_nothing() -> None:
    state = attended(mission(), uav(queue=[10.0, 60.0])).state
    state.battery[1] = 0.0
    assert decide_by_urgency(state, PAPER, frozenset())[0] == 0
