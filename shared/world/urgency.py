"""The worth of a visit: how urgent a sensor's packets are, and what flying on is worth.

Look-ahead chooses the sensor j and the velocity v of greatest ``U_j min(q_j, packets movable from the new position) +
0.5 v``. It exists for the edge's decisions (``Reach`` and ``service.deciding.advisers``), for a fleet's first plan
(:mod:`shared.planning.greedy`) and, compiled, for the flights of the rollout evaluator.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario

# The worth of a metre a second in urgent packets: while a UAV dwells at few packets, sensors further on overflow.
VELOCITY_BONUS = 0.5

# The probability of no packet at this mean is still far from the smallest number.
_SMALL_MEAN = 600.0


@compiled
def above_poisson(room: FloatArray, mean: FloatArray, above: FloatArray) -> None:
    """Write ``P(Poisson(mean) > room)``: one minus the sum of the probabilities of 0 to ``room`` packets.

    Args:
        room: whole numbers from 0, shape ``(n,)``.
        mean: packets, at least 0, shape ``(n,)``.
        above: shape ``(n,)``, is written.
    """
    for i in range(len(room)):
        # More packets are as good as impossible.
        most, total = int(min(room[i], mean[i] + 12.0 * math.sqrt(mean[i]) + 40.0)), 0.0
        if mean[i] < _SMALL_MEAN:
            probability = math.exp(-mean[i])
            total = probability
            for packets in range(1, most + 1):
                probability *= mean[i] / packets
                total += probability
        else:
            logarithm = -mean[i]
            for packets in range(1, most + 1):
                logarithm += math.log(mean[i] / packets)
                total += math.exp(logarithm)
        above[i] = min(max(1.0 - total, 0.0), 1.0)


@compiled
def _above_by_level(mean: FloatArray, above: FloatArray) -> None:
    """Write ``P(Poisson(mean) > W - q)`` for q of 0 to W packets, ``(W + 1, n)``, as :func:`above_poisson` sums it."""
    capacity = above.shape[0] - 1
    for i in range(len(mean)):
        most, small = int(min(capacity, mean[i] + 12.0 * math.sqrt(mean[i]) + 40.0)), mean[i] < _SMALL_MEAN
        probability, logarithm = math.exp(-mean[i]) if small else 0.0, -mean[i]
        total = probability
        for packets in range(capacity + 1):
            if 0 < packets <= most:
                if small:
                    probability *= mean[i] / packets
                else:
                    logarithm += math.log(mean[i] / packets)
                    probability = math.exp(logarithm)
                total += probability
            above[capacity - packets, i] = min(max(1.0 - total, 0.0), 1.0)


def urgency_by_level(rate: FloatArray, scenario: Scenario) -> FloatArray:
    """:func:`urgency` of queues of 0 to W packets with arrivals at rates ``(n,)``, shape ``(W + 1, n)``."""
    levels = np.arange(scenario.queue_capacity + 1, dtype=np.float64)[:, None]
    above = np.empty((len(levels), len(rate)))
    _above_by_level(rate * scenario.overflow_horizon_steps, above)
    return urgency_of(levels, above, scenario)


def with_bonus(worth: FloatArray, velocities: NDArray[np.int64]) -> FloatArray:
    """Add to the worth ``(V, J)`` of urgent packets, in place, that of the velocities ``(V,)``."""
    worth += VELOCITY_BONUS * velocities[:, None]
    return worth


def overflow_probability(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``Pof_j = P(Poisson(rate_j x horizon) > W - q_j)``, in 0..1, shape ``(J,)``.

    Args:
        queue: packets waiting, shape ``(J,)``; clipped to 0..W.
        rate: arrival rate in packets a step, shape ``(J,)``, at least 0.
    """
    capacity = scenario.queue_capacity
    # For a few numbers np.clip takes several times as long.
    room = np.floor(capacity - np.minimum(np.maximum(np.asarray(queue, dtype=np.float64), 0), capacity))
    mean = np.asarray(rate, dtype=np.float64) * scenario.overflow_horizon_steps
    # Copies, because numba would compile the function again for arrays that are read-only.
    both = np.empty((3, *np.broadcast(room, mean).shape))
    both[0], both[1] = room, mean
    above_poisson(both[0].ravel(), both[1].ravel(), both[2].ravel())
    return np.asarray(both[2])


def urgency(queue: ArrayLike, rate: ArrayLike, scenario: Scenario) -> FloatArray:
    """``U_j = 0.5 q_j / W + 0.5 Pof_j``, in 0..1, shape ``(J,)``; arguments as :func:`overflow_probability`."""
    return urgency_of(queue, overflow_probability(queue, rate, scenario), scenario)


def urgency_of(queue: ArrayLike, overflow: FloatArray, scenario: Scenario) -> FloatArray:
    """As :func:`urgency`, from known probabilities ``Pof_j``, shape ``(J,)``."""
    fill = np.asarray(queue, dtype=np.float64) / scenario.queue_capacity
    return np.asarray(0.5 * np.minimum(np.maximum(fill, 0.0), 1.0) + 0.5 * overflow)
