"""Means over seeds with 95% bootstrap intervals, single and paired; deterministic in their inputs.

Intervals are bias-corrected and accelerated (BCa, Efron 1987), by scipy. If BCa is undefined (samples nearly all equal,
or very few), they are percentile intervals. If all samples are equal, or there is only one, the interval is the mean
itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from lab.experiments.result import Curve, Interval, Paired
from shared.world.channel import FloatArray

METHOD = "95% bootstrap interval (BCa)"
_SEED = 0
_RESAMPLES = 9999
# Fewer for curves, which have an interval a step and need less precision.
_CURVE_RESAMPLES = 2000
_MEDIANS = 5000

Statistic = Callable[..., Any]


def interval(values: Sequence[float]) -> Interval:
    """Mean and interval of one value a seed; raises ``ValueError`` without any."""
    sample = np.asarray(values, dtype=float)
    if not len(sample):
        raise ValueError("no values to take a mean of")
    low, high = _bounds((sample,), np.mean, _RESAMPLES)
    return Interval(mean=float(sample.mean()), low=float(low), high=float(high), values=sample.tolist())


def curve(rows: Sequence[Sequence[float]]) -> Curve:
    """Mean and interval at each step, from one row of T values a seed."""
    sample = np.asarray(rows, dtype=float).T
    low, high = np.array([_bounds((at_step,), np.mean, _CURVE_RESAMPLES) for at_step in sample]).T
    return Curve(mean=sample.mean(axis=1).tolist(), low=low.tolist(), high=high.tolist())


def paired(
    scheme: str, reference: str, measure: str, values: Sequence[float], reference_values: Sequence[float]
) -> list[Paired]:
    """The difference of the means and, unless the reference's is 0, their ratio; resampled by seed.

    Args:
        values: of ``scheme``, one a seed.
        reference_values: of ``reference``, on the same seeds in the same order.
    """
    ours, theirs = np.asarray(values, dtype=float), np.asarray(reference_values, dtype=float)
    low, high = _bounds((ours - theirs,), np.mean, _RESAMPLES)
    names = {"scheme": scheme, "reference": reference, "measure": measure}
    found = [Paired(**names, kind="difference", mean=float((ours - theirs).mean()), low=float(low), high=float(high))]
    if theirs.mean() == 0:
        return found
    low, high = _bounds((ours, theirs), _ratio, _RESAMPLES)
    # In a resample of seeds on which the reference lost nothing, the ratio is undefined.
    if np.isfinite([low, high]).all():
        mean = float(ours.mean() / theirs.mean())
        found.append(Paired(**names, kind="ratio", mean=mean, low=float(low), high=float(high)))
    return found


def ratio_of_medians(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    """The ratio of medians of times measured side by side, and its 95% percentile bootstrap interval over the pairs.

    Other work on the machine slows both, and outliers count little. A median has too few values for BCa.
    """
    samples = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
    found = float(_of_medians(*samples))
    if len(samples[0]) < 2:
        return [found, found, found]
    drawn = np.random.default_rng(_SEED)
    resampled = bootstrap(samples, _of_medians, paired=True, n_resamples=_MEDIANS, method="percentile", rng=drawn)
    return [found, float(resampled.confidence_interval.low), float(resampled.confidence_interval.high)]


def _of_medians(ours: FloatArray, theirs: FloatArray, axis: int = -1) -> Any:
    return np.median(ours, axis=axis) / np.median(theirs, axis=axis)


def _ratio(a: FloatArray, b: FloatArray, axis: int = -1) -> Any:
    with np.errstate(divide="ignore", invalid="ignore"):
        return a.mean(axis=axis) / b.mean(axis=axis)


def _bounds(samples: tuple[FloatArray, ...], statistic: Statistic, resamples: int) -> tuple[float, float]:
    if len(samples[0]) == 1 or all(np.ptp(sample) == 0 for sample in samples):
        only = float(statistic(*samples))
        return only, only
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            found = bootstrap(
                samples,
                statistic,
                paired=len(samples) > 1,
                n_resamples=resamples,
                method=method,
                rng=np.random.default_rng(_SEED),
            ).confidence_interval
        if np.isfinite([found.low, found.high]).all():
            break
    return float(found.low), float(found.high)
