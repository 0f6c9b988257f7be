"""The queues' chains keep the mean, and expect the losses that simulated queues have."""

from __future__ import annotations

import numpy as np
import pytest

from shared.planning.queue_chains import Arriving, Floats, QueueChains, queue_chains
from shared.world.channel import FloatArray


def chains(
    base: float, mean: float, variance: float, capacity: int, horizon: int = 3, base_variance: float = 0.0
) -> QueueChains:
    """One sensor's."""
    nothing, later = np.zeros(1), np.array([[2.0], [5.0]])
    return queue_chains(
        base=np.array([base]),
        base_variance=np.array([base_variance]),
        came=Arriving(nothing, nothing),
        coming=Arriving(np.full((horizon, 1), mean), np.full((horizon, 1), variance)),
        later=Arriving(later * mean, later * variance),
        capacity=capacity,
        best_chance=np.array([0.5]),
        weights=np.ones(1),
    )


def transitions(arrive: Floats) -> FloatArray:
    """The probabilities from level to level ``(G + 1, G + 1)`` by those of the levels that come ``(G + 1,)``."""
    move = np.zeros((len(arrive), len(arrive)))
    for level, more in np.ndindex(move.shape):
        move[level, min(level + more, len(arrive) - 1)] += arrive[more]
    return move


@pytest.mark.parametrize("capacity", [7, 30, 60, 250])
@pytest.mark.parametrize(("mean", "variance"), [(0.0, 0.0), (3.0, 1.0), (5.0, 5.0), (5.0, 40.0), (90.0, 200.0)])
def test_packets_that_come_stay_or_are_lost(capacity: int, mean: float, variance: float) -> None:
    made = chains(0.0, mean, variance, capacity)
    levels = np.arange(made.start.shape[1]) * made.level
    after = transitions(made.arrive[0, 0]) @ levels + made.lost[0, 0]
    np.testing.assert_allclose(after, levels + mean, rtol=2e-3, atol=0.02 * made.level)
    np.testing.assert_allclose(made.arrive.sum(axis=-1), 1.0, rtol=1e-5)


def simulated(base: float, rate: float, spread: float, capacity: int, steps: int) -> FloatArray:
    """The mean packets lost in each step by queues with Poisson arrivals of Gamma rates."""
    random = np.random.default_rng(5)
    queue, lost = np.full(200_000, base), []
    for _ in range(steps):
        mean = random.gamma(rate / spread, spread, len(queue)) if spread else np.full(len(queue), rate)
        queue = queue + random.poisson(mean)
        lost.append(float(np.maximum(queue - capacity, 0.0).mean()))
        queue = np.minimum(queue, capacity)
    return np.array(lost)


@pytest.mark.parametrize(("capacity", "spread"), [(30, 0.0), (30, 2.0), (60, 0.0), (60, 2.0)])
def test_the_losses_are_those_of_simulated_queues(capacity: int, spread: float) -> None:
    base, rate = capacity - 12.0, 5.0
    made = chains(base, rate, rate * (1.0 + spread), capacity)
    odds, lost = made.start[0], []
    for step in range(3):
        lost.append(float(odds @ made.lost[step, 0]))
        odds = odds @ transitions(made.arrive[step, 0])
    expected = simulated(base, rate, spread, capacity, 8)
    np.testing.assert_allclose(lost, expected[:3], rtol=0.05, atol=0.03)
    first, second = (float(odds @ made.after[stage, 0]) for stage in (0, 1))
    assert first == pytest.approx(expected[3:5].sum(), rel=0.05)
    assert second == pytest.approx(expected[3:5].sum() + 0.5 * expected[5:8].sum(), rel=0.05)


def test_an_unheard_queue_is_spread_around_its_mean() -> None:
    made = chains(30.0, 0.0, 0.0, 60, base_variance=12.0**2)
    levels = np.arange(made.start.shape[1]) * made.level
    mean = float(made.start[0] @ levels)
    assert mean == pytest.approx(30.0, abs=0.1)
    assert float(made.start[0] @ (levels - mean) ** 2) == pytest.approx(12.0**2, rel=0.3)


@pytest.mark.parametrize(("capacity", "room"), [(250, 12.0), (2_000, 12.0), (2_000, 30.0), (100_000, 12.0)])
def test_a_large_queue_is_as_fine_at_its_upper_end(capacity: int, room: float) -> None:
    made = chains(capacity - room, 5.0, 5.0, capacity)
    assert made.level < 4
    odds, lost = made.start[0], []
    for step in range(3):
        lost.append(float(odds @ made.lost[step, 0]))
        odds = odds @ transitions(made.arrive[step, 0])
    np.testing.assert_allclose(lost, simulated(capacity - room, 5.0, 0.0, capacity, 3), rtol=0.1, atol=0.25)
    # A queue that is far from full is at the lowest level.
    assert chains(capacity / 3, 5.0, 5.0, capacity).start[0, 0] == pytest.approx(1.0)
