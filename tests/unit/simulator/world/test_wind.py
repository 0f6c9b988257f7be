"""The wind: what a UAV covers of ``velocity x step_s``."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories
from simulator.world.environment import PipelineWorld
from simulator.world.truth import Wind

# There and back, from west to east.
EAST: tuple[tuple[float, float], ...] = ((0.0, 0.0), (3000.0, 0.0))
LINE = Scenario(name="line", uavs=1, routes=(EAST,), area_m=3000.0)


def flown(scenario: Scenario, velocity: int, progress_m: float = 100.0, instant: int = 0) -> float:
    paths: tuple[Trajectory, ...] = trajectories(scenario)
    wind = Wind.draw(scenario, np.random.default_rng(5))
    found: FloatArray = wind.flown_m(np.array([velocity]), np.array([progress_m]), paths, instant)
    return float(found[0])


@pytest.mark.parametrize(
    ("mps", "from_deg", "expected"),
    [(7, 270, 150.0), (7, 90, 50.0), (7, 0, 100.0), (14, 90, 0.0), (50, 90, 0.0), (50, 270, 200.0)],
)
def test_tail_wind_helps_head_wind_hinders_and_cross_wind_does_neither(
    mps: float, from_deg: float, expected: float
) -> None:
    world = LINE.model_copy(update={"wind_mps": mps, "wind_from_deg": from_deg})
    assert flown(world, 10) == pytest.approx(expected, abs=1e-6)
    assert flown(world, 0) == 0.0


def test_the_way_back_has_the_opposite_wind() -> None:
    world = LINE.model_copy(update={"wind_mps": 7.0, "wind_from_deg": 270.0})
    assert flown(world, 10, 3500.0) == pytest.approx(50.0)
    # Where the way turns back, it has no direction.
    assert flown(world, 10, 2950.0) == pytest.approx(100.0)


def test_gusts_are_new_in_each_step_around_the_mean() -> None:
    world = LINE.model_copy(update={"gust_mps": 2.0})
    ways = np.array([flown(world, 10, instant=instant) for instant in range(400)])
    assert ways.mean() == pytest.approx(100.0, abs=3.0)
    assert ways.std() == pytest.approx(100.0 * 2.0 / 14.0, rel=0.15)
    assert flown(world, 10, instant=7) == ways[7]


def test_still_air_is_velocity_times_step() -> None:
    assert [flown(LINE, velocity) for velocity in (0, 3, 14)] == [0.0, 30.0, 140.0]


def test_the_progress_reported_is_the_one_flown() -> None:
    world = PipelineWorld(Scenario(wind_mps=6.0, gust_mps=2.0, position_noise_m=3.0))
    before, _ = world.reset(seed=0)
    after, *_ = world.step(dict.fromkeys(world.agents, (0, 10)))
    covered = [float(after[a]["progress"][0] - before[a]["progress"][0]) for a in world.agents]
    assert len({round(way, 3) for way in covered}) == 3
    assert all(0.0 < way < 200.0 and way != 100.0 for way in covered)
    np.testing.assert_array_equal([after[a]["progress"][0] for a in world.agents], world.fleet.progress_m)
