"""The urgency of a sensor: its queue, and the probability that it overflows before the next visit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from shared.channel import FloatArray
from shared.scenario import Scenario

# Terms of the sum in memory at the same time.
_TERMS = 1_000_000


def above_by_sum(room: FloatArray, mean: FloatArray) -> FloatArray:
    """``P(Poisson(mean) > room)`` by the sum of the probabilities up to ``room``, whole numbers; ``(J,)`` each.

    It equals scipy's to 1e-9, and serves a UAV without scipy that prunes on board.
    """
    counts = np.arange(int(room.max(initial=0)) + 1)
    log_factorials = np.cumsum(np.log(np.maximum(counts, 1)))
    found = np.empty(len(room))
    rows = max(1, _TERMS // len(counts))
    for start in range(0, len(room), rows):
        some = slice(start, start + rows)
        log_mean = np.log(np.maximum(mean[some, None], 1e-300))
        terms = np.exp(counts * log_mean - mean[some, None] - log_factorials)
        found[some] = 1.0 - np.sum(terms, axis=1, where=counts <= room[some, None])
    return np.clip(found, 0.0, 1.0)


try:
    from scipy.special import pdtrc
except ImportError:
    # The simulator's image has no scipy.
    _above: Callable[[FloatArray, FloatArray], FloatArray] = above_by_sum
else:
    _above = pdtrc


def overflow_probability(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``Pof_j = P(Poisson(rate_j x horizon) > W - q_j)``, in 0..1, shape ``(J,)``.

    Args:
        queue: packets waiting, shape ``(J,)``; clipped to 0..W.
        rate: arrival rate in packets a step, shape ``(J,)``, at least 0.
    """
    capacity = scenario.queue_capacity
    # For a few numbers np.clip takes several times as long.
    room = np.floor(capacity - np.minimum(np.maximum(np.asarray(queue, dtype=np.float64), 0), capacity))
    return np.asarray(_above(room, np.asarray(rate, dtype=np.float64) * scenario.overflow_horizon_steps))


def urgency(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``U_j = 0.5 q_j / W + 0.5 Pof_j``, in 0..1, shape ``(J,)``; arguments as :func:`overflow_probability`."""
    return urgency_of(queue, overflow_probability(queue, rate, scenario), scenario)


def urgency_of(queue: ArrayLike, overflow: FloatArray, scenario: Scenario) -> FloatArray:
    """As :func:`urgency`, from known probabilities ``Pof_j``, shape ``(J,)``."""
    fill = np.asarray(queue, dtype=np.float64) / scenario.queue_capacity
    return np.asarray(0.5 * np.minimum(np.maximum(fill, 0.0), 1.0) + 0.5 * overflow)
