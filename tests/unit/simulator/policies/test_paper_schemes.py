"""The paper's EOF and WQCS, on observations written by hand and on its world."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.channel import rate_bps
from shared.world.scenario import SCENARIOS
from simulator.flying.flight import rollout
from simulator.policies.hand_written import velocity_by_distance
from simulator.policies.registry import policy_named
from simulator.world.environment import PipelineWorld
from tests.unit.simulator.policies.test_registry import FOUR, NONE, ready, seen


def test_the_velocity_strategy_of_the_prompt() -> None:
    paper = SCENARIOS["paper"]
    assert velocity_by_distance(0.0, paper) == 0
    near = [velocity_by_distance(d, paper) for d in np.linspace(0.1, 50.0, 60)]
    far = [velocity_by_distance(d, paper) for d in np.linspace(50.1, 360.0, 60)]
    assert (near[0], near[-1], far[0], far[-1]) == (1, 7, 8, 14)
    assert near + far == sorted(near + far)
    assert velocity_by_distance(1e4, paper) == 14


def test_wqcs_multiplies_queue_and_rate() -> None:
    near, far = rate_bps(0.0, FOUR), rate_bps(350.0, FOUR)
    enough = 20 * float(near) / float(far)
    for queue, chosen in ((enough - 1.0, 0), (enough + 1.0, 1)):
        assert ready("wqcs").decide(0, seen([20, queue, 0, 0], [5] * 4, [0, 350, 350, 350]), NONE)[0] == chosen


def test_eof_observes_the_growth_of_each_queue() -> None:
    policy = ready("eof")
    policy.decide(0, seen([10, 30, 0, 0], [5] * 4), NONE)
    # Sensor 0 overflows in two steps, sensor 1 in five although its queue is as long.
    assert policy.decide(0, seen([40, 40, 0, 0], [7] * 4, now=7), NONE)[0] == 0
    # A collection empties the queues, and the observed growth stays.
    assert policy.decide(0, seen([10, 10, 0, 0], [8] * 4, now=8), NONE)[0] == 0
    # Another UAV has not observed it: of equals the first in range.
    assert policy.decide(1, seen([40, 40, 41, 0], [8] * 4, now=8), NONE)[0] == 2


def test_eof_prefers_the_better_channel() -> None:
    assert ready("eof").decide(0, seen([30] * 4, [5] * 4, [300, 100, 200, 350]), NONE)[0] == 1


@pytest.mark.parametrize("name", ["eof", "wqcs"])
def test_only_a_coordinated_scheme_leaves_taken_sensors(name: str) -> None:
    observation = seen([30, 60, 50, 40], [5, 5, 5, 5])
    assert ready(name).decide(1, observation, frozenset({1}))[0] == 1
    assert ready(f"{name}_coordinated").decide(1, observation, frozenset({1}))[0] == 2


@pytest.mark.parametrize(
    ("name", "low", "high"),
    # The intervals of another implementation of the paper's text, over these worlds.
    [("eof", 135, 192), ("wqcs", 82, 126)],
)
def test_losses_on_paper(name: str, low: float, high: float) -> None:
    world = PipelineWorld()
    lost = [sum(t.lost_packets for t in rollout(world, policy_named(name), seed)) for seed in range(30)]
    assert low <= np.mean(lost) <= high
