"""Arrivals in bursts, and noise by instant."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.scenario import Scenario
from simulator.world.sensors import Sensors, StepNoise, Streams, draw_bursts

BURSTY = Scenario(name="bursty", sensors=100, steps=4000, burst_factor=6.0, burst_steps=4.0, calm_steps=12.0)


def test_the_two_rates_have_their_ratio_and_the_mean_one() -> None:
    factors = draw_bursts(BURSTY, np.random.default_rng(0))
    calm, burst = np.unique(factors)
    assert burst / calm == pytest.approx(6.0)
    assert factors.mean() == pytest.approx(1.0, rel=0.02)
    assert (factors == burst).mean() == pytest.approx(0.25, rel=0.05)
    # A mission begins anywhere in a burst or between two.
    many = np.concatenate([draw_bursts(BURSTY, np.random.default_rng(seed))[0] for seed in range(20)])
    assert (many == burst).mean() == pytest.approx(0.25, rel=0.2)


def test_bursts_and_calm_have_their_mean_lengths() -> None:
    factors = draw_bursts(BURSTY, np.random.default_rng(1))
    inside = factors > 1.0
    starts = np.count_nonzero(inside[1:] & ~inside[:-1])
    assert np.count_nonzero(inside) / starts == pytest.approx(4.0, rel=0.05)
    assert np.count_nonzero(~inside) / starts == pytest.approx(12.0, rel=0.05)


def test_arrivals_follow_the_bursts_and_keep_each_sensors_mean() -> None:
    streams = [Streams.of(np.random.SeedSequence(2)) for _ in range(2)]
    bursty = Sensors.draw(BURSTY, streams[0])
    steady = Sensors.draw(BURSTY.model_copy(update={"burst_factor": 1.0}), streams[1])
    np.testing.assert_array_equal(bursty.rates, steady.rates)
    assert bursty.arrivals.mean() == pytest.approx(steady.arrivals.mean(), rel=0.03)
    assert bursty.arrivals.var(axis=0).mean() > 2 * steady.arrivals.var(axis=0).mean()


def test_many_worlds_noise_is_each_worlds_own() -> None:
    small = [0, 1, 2**32 - 1, 2**32, 2**63 - 1]
    keys = np.concatenate([np.random.default_rng(3).integers(2**63, size=70), small])
    for instant in (0, 1, 29):
        alone = [np.random.default_rng([key, instant]).standard_normal((3, 2)) for key in keys.tolist()]
        np.testing.assert_array_equal(StepNoise(keys).normal(instant, (3, 2)), alone)
        np.testing.assert_array_equal(StepNoise(keys[-5:]).normal(instant, (3, 2)), alone[-5:])
