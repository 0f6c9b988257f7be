"""Fading, and the errors of reported positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from simulator.world.environment import PipelineWorld
from simulator.world.sensors import StepNoise, Streams
from simulator.world.truth import Truth

CROWD = Scenario(name="crowd", sensors=2000)


def truth(scenario: Scenario) -> Truth:
    return Truth.draw(scenario, Streams.of(np.random.SeedSequence(0)))


@pytest.mark.parametrize("k_db", [-40.0, 0.0, 3.0, 15.0])
def test_fading_has_mean_power_one_and_the_spread_of_its_k(k_db: float) -> None:
    channel = truth(CROWD.model_copy(update={"rician_k_db": k_db})).channel
    power = 10 ** (-np.concatenate([channel.fade_db(instant) for instant in range(10)]).ravel() / 10)
    k = 10 ** (k_db / 10)
    assert power.mean() == pytest.approx(1.0, rel=0.02)
    # The variance of a Rician power of mean 1.
    assert power.var() == pytest.approx((1 + 2 * k) / (1 + k) ** 2, rel=0.06)


def test_fading_is_new_in_each_step_and_the_same_when_asked_again() -> None:
    channel = truth(CROWD.model_copy(update={"rician_k_db": 3.0})).channel
    third, fourth = channel.fade_db(3), channel.fade_db(4)
    assert abs(np.corrcoef(third.ravel(), fourth.ravel())[0][1]) < 0.05
    np.testing.assert_array_equal(channel.fade_db(3), third)


def test_positions_are_reported_with_an_error_of_the_scenarios_size() -> None:
    world = PipelineWorld(Scenario(uavs=100, position_noise_m=3.0))
    observations, _ = world.reset(seed=0)
    reported = np.array([observations[agent]["position"] for agent in world.agents])
    errors = reported - world.fleet.positions
    assert errors.std() == pytest.approx(3.0, rel=0.15)
    assert abs(errors).max() <= 15.0
    after, *_ = world.step(dict.fromkeys(world.agents, (0, 0)))
    again = np.array([after[agent]["position"] for agent in world.agents]) - world.fleet.positions
    assert not np.any(again == errors)


def test_no_position_is_reported_farther_off_than_five_deviations_on_an_axis() -> None:
    class Wild(StepNoise):
        def normal(self, instant: int, shape: tuple[int, ...]) -> FloatArray:
            return np.array([[7.0, -9.0], [-0.5, 2.0]])

    world = replace(truth(Scenario(position_noise_m=3.0)), position_noise=Wild(np.zeros((), dtype=np.int64)))
    assert world.reported(np.full((2, 2), 100.0), 1).tolist() == [[115.0, 85.0], [98.5, 106.0]]


def test_other_draws_do_not_shift_those_that_the_model_knows() -> None:
    plain, other = PipelineWorld(), PipelineWorld(
        Scenario(shadowing_db=8.0, rician_k_db=0.0, wind_mps=5.0, dead_radios=2, departures=1, position_noise_m=2.0)
    )  # fmt: skip
    plain.reset(seed=4)
    other.reset(seed=4)
    for name in ("positions", "rates", "arrivals", "initial_queue"):
        np.testing.assert_array_equal(getattr(plain.sensors, name), getattr(other.sensors, name))
    np.testing.assert_array_equal(plain.fleet.start_m, other.fleet.start_m)
