"""Ratios of medians of times measured side by side: other work slows both, and outliers count little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from shared.world.channel import FloatArray

_RESAMPLES = 5000


def ratio_of_medians(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    """The ratio, and its 95% bootstrap interval over the pairs (percentiles: a median has few values to accelerate)."""
    samples = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
    found = float(_ratio(*samples))
    if len(samples[0]) < 2:
        return [found, found, found]
    around = bootstrap(
        samples,
        _ratio,
        paired=True,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return [found, float(around.low), float(around.high)]


def shown(ratio: Sequence[float]) -> str:
    """Such as ``0.12 [0.10, 0.15]``."""
    mean, low, high = ratio
    return f"{mean:.3g} [{low:.3g}, {high:.3g}]"


def _ratio(ours: FloatArray, theirs: FloatArray, axis: int = -1) -> Any:
    return np.median(ours, axis=axis) / np.median(theirs, axis=axis)
