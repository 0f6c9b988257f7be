"""How urgent a sensor is: its queue, and the probability that it overflows before the next visit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from shared.channel import FloatArray
from shared.scenario import Scenario


def overflow_probability(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``Pof_j = P(Poisson(rate_j x horizon) > W - q_j)``, in 0..1, shape ``(J,)``.

    Args:
        queue: packets waiting, shape ``(J,)``, 0..W.
        rate: arrival rate in packets a step, shape ``(J,)``, at least 0.
    """
    q = np.atleast_1d(np.asarray(queue, dtype=np.float64))
    mean = np.atleast_1d(np.asarray(rate, dtype=np.float64)) * scenario.overflow_horizon_steps
    room = np.clip(np.floor(scenario.queue_capacity - q), 0, scenario.queue_capacity).astype(np.int64)
    counts = np.arange(int(room.max(initial=0)) + 1)
    log_factorial = np.concatenate(([0.0], np.cumsum(np.log(counts[1:]))))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_pmf = counts * np.log(mean)[:, None] - mean[:, None] - log_factorial
    pmf = np.exp(np.where((counts == 0) | (mean[:, None] > 0), log_pmf, -np.inf))
    pmf[:, 0] = np.exp(-mean)
    cdf = np.cumsum(pmf, axis=1)[np.arange(len(q)), room]
    return np.clip(1.0 - cdf, 0.0, 1.0)


def urgency(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``U_j = 0.5 q_j / W + 0.5 Pof_j``, in 0..1, shape ``(J,)``."""
    fill = np.atleast_1d(np.asarray(queue, dtype=np.float64)) / scenario.queue_capacity
    return 0.5 * np.clip(fill, 0.0, 1.0) + 0.5 * overflow_probability(queue, rate, scenario)
