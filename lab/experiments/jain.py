"""Jain's index of random visits, and of visits in proportion to need.

With n_j visits of sensor j, N in all and J sensors, Jain's index is N^2 / (J sum n_j^2) = 1 / (1 + X/N), where
X = sum (n_j - N/J)^2 / (N/J) is Pearson's statistic against equal visits. Where each of N/I steps visits I different
sensors, drawn uniformly, n_j has the variance (N/J) (1 - I/J), so E[X] = J - I, and X is about (J - I)/(J - 1) times
a chi-squared variable of J - 1 degrees of freedom. With I = 1 all visits are independent draws.
"""

from __future__ import annotations

from scipy.stats import chi2


def expected_by_chance(visits: int, sensors: int, at_once: int = 1) -> float:
    """Mean of the index of uniformly random visits, ``at_once`` different sensors a step, to second order in 1/N."""
    mean = (sensors - at_once) / visits
    # Exact for visits drawn one by one.
    variance = 2 * (sensors - at_once) ** 2 / (sensors - 1) * (1 - at_once / visits) / visits**2
    return 1 / (1 + mean) + variance / (1 + mean) ** 3


def reached_by_chance(index: float, visits: int, sensors: int, at_once: int = 1) -> float:
    """Probability that such visits have an index of at least ``index``."""
    scale = (sensors - at_once) / (sensors - 1)
    return float(chi2.cdf(visits * (1 / index - 1) / scale, sensors - 1))


def of_proportional_visits(low: float, high: float, sensors: int) -> float:
    """The approximate index of visits in proportion to arrival rates that are uniform in ``low .. high``.

    It is the squared mean over the mean of squares, with the expected sample variance of ``sensors`` draws.
    """
    mean, variance = (low + high) / 2, (high - low) ** 2 / 12
    return mean**2 / (mean**2 + variance * (sensors - 1) / sensors)
