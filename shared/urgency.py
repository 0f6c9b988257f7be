"""How urgent a sensor is: its queue, and the probability that it overflows before the next visit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import pdtrc

from shared.channel import FloatArray
from shared.scenario import Scenario


def overflow_probability(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``Pof_j = P(Poisson(rate_j x horizon) > W - q_j)``, in 0..1, shape ``(J,)``.

    Args:
        queue: packets waiting, shape ``(J,)``; clipped to 0..W.
        rate: arrival rate in packets a step, shape ``(J,)``, at least 0.
    """
    room = np.floor(scenario.queue_capacity - np.clip(np.asarray(queue, dtype=np.float64), 0, scenario.queue_capacity))
    return np.asarray(pdtrc(room, np.asarray(rate, dtype=np.float64) * scenario.overflow_horizon_steps))


def urgency(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``U_j = 0.5 q_j / W + 0.5 Pof_j``, in 0..1, shape ``(J,)``."""
    fill = np.asarray(queue, dtype=np.float64) / scenario.queue_capacity
    return np.asarray(0.5 * np.clip(fill, 0.0, 1.0) + 0.5 * overflow_probability(queue, rate, scenario))
