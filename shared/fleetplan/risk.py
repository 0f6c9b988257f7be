"""The packets that a sensor is expected to lose, by how long it is left alone, when its arrivals are only estimated."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.channel import FloatArray

_erf = np.frompyfunc(math.erf, 1, 1)


def normal_below(z: ArrayLike) -> FloatArray:
    """``Phi(z)``, of the shape of z. By the standard library: planning is to need no more than OR-Tools."""
    return np.asarray(0.5 * (1.0 + np.asarray(_erf(np.asarray(z) / math.sqrt(2.0)), dtype=np.float64)))


def expected_overflow(mean: ArrayLike, variance: ArrayLike, capacity: float) -> FloatArray:
    """``E[(X - W)+]`` of a normal X, packets: what a queue without a visit has lost when X came, whatever the order.

    ``(mean - W) Phi(z) + sd phi(z)`` with ``z = (mean - W) / sd``; shapes broadcast.
    """
    sd = np.sqrt(np.maximum(np.asarray(variance, dtype=np.float64), 1e-12))
    over = np.asarray(mean, dtype=np.float64) - capacity
    z = over / sd
    return np.asarray(over * normal_below(z) + sd * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))


def neglect(
    base: FloatArray,
    base_variance: FloatArray,
    age: NDArray[np.int64],
    rate: FloatArray,
    rate_variance: FloatArray,
    capacity: int,
    horizon: int,
    beyond: int,
) -> FloatArray:
    """What a plan pays for neglecting sensors: the ``risk`` of a :class:`~shared.fleetplan.problem.FleetProblem`.

    In n steps ``n rate`` packets come on average, with the variance ``n rate + n^2 rate_variance``: Poisson's and
    that of the estimate.

    Args:
        base: packets last known of, ``(J,)``.
        base_variance: their variance, ``(J,)``.
        age: steps since then, ``(J,)``.
        rate: expected packets a step, ``(J,)``.
        rate_variance: of that estimate, ``(J,)``.
        capacity: W, packets.
        horizon: steps H of the plan.
        beyond: steps after the plan whose losses count too, at least 0.

    Returns:
        Shape ``(H + 1, H + 1, J)``.
    """
    steps = np.arange(horizon + beyond + 3)[:, None]

    def lost_by(start: FloatArray | float, variance: FloatArray | float, n: NDArray[np.int64]) -> FloatArray:
        return expected_overflow(start + n * rate, variance + n * rate + n**2 * rate_variance, capacity)

    emptied, untouched = lost_by(0.0, 0.0, steps), lost_by(base, base_variance, steps + age)
    risk = np.zeros((horizon + 1, horizon + 1, len(rate)))
    for since in range(horizon + 1):
        course, first = (untouched, 0) if since == 0 else (emptied, since - 1)
        for step in range(since, horizon + 1):
            last = step + 1 if step < horizon else horizon + beyond
            risk[since, step] = course[last - first] - course[step - first]
    return risk
