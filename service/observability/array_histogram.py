"""A Prometheus histogram that takes arrays of values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric
from prometheus_client.registry import Collector


class ArrayHistogram(Collector):
    """A histogram without labels; prometheus_client's own takes one value a call.

    Args:
        buckets: upper bounds, ascending; the last bucket is without a bound.
    """

    def __init__(self, name: str, documentation: str, registry: CollectorRegistry, buckets: Sequence[float]) -> None:
        self._name, self._documentation = name, documentation
        self._bounds = np.array(buckets, dtype=np.float64)
        self._labels = [*(str(float(bound)) for bound in buckets), "+Inf"]
        self._counts = np.zeros(len(self._labels), dtype=np.int64)
        self._sum = 0.0
        registry.register(self)

    def observe(self, values: ArrayLike) -> None:
        """Count values ``(n,)``; a value that equals a bound is in the bound's bucket."""
        taken = np.asarray(values, dtype=np.float64)
        self._counts += np.bincount(self._bounds.searchsorted(taken), minlength=len(self._counts))
        self._sum += float(np.add.reduce(taken))

    def collect(self) -> Iterable[Metric]:
        """The histogram as it is now."""
        # HistogramMetricFamily has neither count nor sum where a bound is negative.
        metric = Metric(self._name, self._documentation, "histogram")
        for label, below in zip(self._labels, np.cumsum(self._counts).tolist(), strict=True):
            metric.add_sample(f"{self._name}_bucket", {"le": label}, below)
        metric.add_sample(f"{self._name}_count", {}, int(self._counts.sum()))
        metric.add_sample(f"{self._name}_sum", {}, self._sum)
        yield metric
