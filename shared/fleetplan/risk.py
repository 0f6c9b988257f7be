"""The expected loss of a sensor by the time without a visit, for estimated arrivals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.channel import FloatArray

_erf = np.frompyfunc(math.erf, 1, 1)


def normal_below(z: ArrayLike) -> FloatArray:
    """``Phi(z)``, of the shape of z. It uses the standard library: planning needs no package but OR-Tools."""
    return np.asarray(0.5 * (1.0 + np.asarray(_erf(np.asarray(z) / math.sqrt(2.0)), dtype=np.float64)))


def expected_overflow(mean: ArrayLike, variance: ArrayLike, capacity: float) -> FloatArray:
    """``E[(X - W)+]`` of a normal X, packets: the loss of a queue without a visit and with X arrivals in any order.

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
    beyond: Sequence[int],
    dispersion: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """The price of neglecting sensors in a plan: the ``risk`` of a :class:`~shared.fleetplan.problem.FleetProblem`.

    In n steps ``n rate`` packets come on average, with the variance ``n rate dispersion + n^2 rate_variance``: the
    arrivals' and the estimate's.

    Args:
        base: the last known packets, ``(J,)``.
        base_variance: their variance, ``(J,)``.
        age: steps since then, ``(J,)``.
        rate: expected packets a step, ``(J,)``.
        rate_variance: the estimate's variance, ``(J,)``.
        capacity: W, packets.
        horizon: steps H of the plan.
        beyond: by stage (K), steps after the plan whose losses count too, at least 0.
        dispersion: the arrivals' variance over a Poisson's.

    Returns:
        The risk, shape ``(H + 1, H + 1, J)``, with the first stage's after the plan, and that of
        :class:`~shared.fleetplan.afterwards.Afterwards`, shape ``(K, H + 1, J)``.
    """
    steps = np.arange(horizon + max(beyond) + 3)[:, None]

    def lost_by(start: FloatArray | float, variance: FloatArray | float, n: NDArray[np.int64]) -> FloatArray:
        return expected_overflow(start + n * rate, variance + n * rate * dispersion + n**2 * rate_variance, capacity)

    emptied, untouched = lost_by(0.0, 0.0, steps), lost_by(base, base_variance, steps + age)
    risk = np.zeros((horizon + 1, horizon + 1, len(rate)))
    afterwards = np.zeros((len(beyond), horizon + 1, len(rate)))
    ends = horizon + np.asarray(beyond)
    for since in range(horizon + 1):
        course, first = (untouched, 0) if since == 0 else (emptied, since - 1)
        for step in range(since, horizon):
            risk[since, step] = course[step + 1 - first] - course[step - first]
        afterwards[:, since] = course[ends - first] - course[horizon - first]
    risk[:, horizon] = afterwards[0]
    return risk, afterwards
