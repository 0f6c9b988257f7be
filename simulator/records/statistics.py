"""Means, percentiles and Jain's index over decisions."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from simulator.records.decision import Decision


def visits_per_sensor(decisions: Iterable[Decision], sensors: int) -> list[int]:
    """The number of successful visits of each of ``sensors`` sensors."""
    served = Counter(d.sensor_id for d in decisions if not d.failed)
    return [served[j] for j in range(sensors)]


def jain_index(values: Sequence[float]) -> float | None:
    """Jain's fairness index, from 1/n (one value has all) to 1 (all equal); ``None`` if every value is 0."""
    squares = sum(v * v for v in values)
    return sum(values) ** 2 / (len(values) * squares) if squares else None


def mean(values: Sequence[float]) -> float | None:
    """The mean; ``None`` for an empty sequence."""
    return sum(values) / len(values) if values else None


def percentile(values: list[float], q: float) -> float | None:
    """The ``q``-th percentile; ``None`` for an empty list."""
    return float(np.percentile(values, q)) if values else None
