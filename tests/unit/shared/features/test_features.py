"""Overflow probability against SciPy's Poisson, and the bounds of urgency."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import pdtrc

from shared.world.scenario import SCENARIOS, Scenario
from shared.world.urgency import above_poisson, overflow_probability, urgency

PAPER = SCENARIOS["paper"]


def test_overflow_probability_is_the_poisson_tail_past_the_room_left() -> None:
    queue, rate = np.meshgrid(np.arange(61.0), [0.0, 0.5, 2.0, 5.0, 8.0, 30.0])
    expected = stats.poisson.sf(60 - queue.ravel(), rate.ravel() * 3.0)
    np.testing.assert_allclose(overflow_probability(queue.ravel(), rate.ravel(), PAPER), expected, rtol=0, atol=1e-13)


def test_a_full_queue_overflows_unless_nothing_arrives() -> None:
    got = overflow_probability([60.0, 60.0], [5.0, 0.0], PAPER)
    assert got.tolist() == [pytest.approx(1 - np.exp(-15.0)), 0.0]


def test_exactly_the_room_left_does_not_overflow() -> None:
    scenario = Scenario(queue_capacity=2, overflow_horizon_steps=1.0)
    # P(Poisson(1) > 1) = 1 - 2/e
    assert overflow_probability([1.0], [1.0], scenario)[0] == pytest.approx(1 - 2 / np.e)


def test_the_horizon_multiplies_the_rate() -> None:
    twice = PAPER.model_copy(update={"overflow_horizon_steps": 6.0})
    np.testing.assert_allclose(overflow_probability([30.0], [4.0], twice), overflow_probability([30.0], [8.0], PAPER))


def test_urgency_is_half_fill_and_half_overflow() -> None:
    queue, rate = np.array([0.0, 30.0, 60.0]), np.array([2.0, 8.0, 8.0])
    expected = 0.5 * queue / 60 + 0.5 * stats.poisson.sf(60 - queue, 3 * rate)
    np.testing.assert_allclose(urgency(queue, rate, PAPER), expected, rtol=0, atol=1e-13)


@given(
    capacity=st.integers(1, 100_000),
    rate=st.floats(0, 1000),
    horizon=st.floats(1e-3, 100),
    fill=st.floats(0, 1),
)
def test_urgency_stays_in_0_to_1_and_never_falls_as_the_queue_fills(
    capacity: int, rate: float, horizon: float, fill: float
) -> None:
    scenario = Scenario(queue_capacity=capacity, overflow_horizon_steps=horizon)
    queue = np.array([0.0, fill * capacity, float(capacity)])
    got = urgency(queue, np.full(3, rate), scenario)
    assert got.shape == (3,)
    assert np.all((got >= 0) & (got <= 1))
    assert np.all(np.diff(got) >= -1e-12)


def test_the_sum_is_scipys() -> None:
    random = np.random.default_rng(0)
    for capacity in (1, 60, 5_000):
        room = np.floor(random.uniform(0, capacity, 400))
        mean = random.uniform(0, 1.2 * capacity, 400) * (random.random(400) > 0.05)
        above = np.empty(400)
        above_poisson(room, mean, above)
        assert np.allclose(above, pdtrc(room, mean), rtol=0, atol=1e-9)
    assert overflow_probability([], [], PAPER).shape == (0,)
