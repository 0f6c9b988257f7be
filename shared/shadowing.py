"""Shadowing: how the excess losses of one sensor's links at several places belong together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Shadowing:
    """A kind of shadowing, as shares of the excess loss's variance that sum to 1.

    ``sensor``: the same at every place. ``place``: by the UAV's place, with the correlation
    ``exp(-distance / range_m)`` (Gudmundson 1991). The rest, ``fading``, differs from step to step.
    """

    sensor: float
    place: float
    range_m: float

    @cached_property
    def fading(self) -> float:
        """The share of the variance that no earlier measurement tells anything about."""
        return 1.0 - self.sensor - self.place


# The likelihood of the measurements chooses between them. The first is the assumption before.
KINDS = (
    Shadowing(sensor=0.4, place=0.4, range_m=60.0),
    *(
        Shadowing(sensor=sensor * (1 - fading), place=(1 - sensor) * (1 - fading), range_m=range_m)
        for sensor in (0.2, 0.6)
        for range_m in (50.0, 150.0)
        for fading in (0.02, 0.2)
    ),
    # A sensor's own excess alone, and fading alone.
    Shadowing(sensor=0.996, place=0.002, range_m=60.0),
    Shadowing(sensor=0.9, place=0.08, range_m=60.0),
    Shadowing(sensor=0.4, place=0.2, range_m=60.0),
    Shadowing(sensor=0.05, place=0.05, range_m=60.0),
)
# The kinds' shares, as columns for arrays (kinds, n, kept, kept), and their ranges, each once.
SENSOR_SHARES = np.array([kind.sensor for kind in KINDS])[:, None, None, None]
PLACE_SHARES = np.array([kind.place for kind in KINDS])[:, None, None, None]
FADINGS = np.array([kind.fading for kind in KINDS])[:, None, None]
RANGES_M, RANGE_OF_KIND = np.unique([kind.range_m for kind in KINDS], return_inverse=True)
RANGES_M = RANGES_M[:, None, None, None]
