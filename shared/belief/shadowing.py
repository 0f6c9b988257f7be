"""Shadowing: the covariance of the excess losses of one sensor's links at several places."""

from dataclasses import dataclass
from functools import cached_property

# The prior of the excess loss's standard deviation, dB, and its weight in measurements. A low weight: the first report
# of a world that equals the formula shows that it does.
PRIOR_DB, PRIOR_WEIGHT = 6.0, 0.03
# The weight of the prior of the offset that all links share, an offset of 0 dB, in independent sensors.
OFFSET_WEIGHT = 2.0


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
        """The share of the variance that earlier measurements cannot explain."""
        return 1.0 - self.sensor - self.place


# The measurements' likelihood selects one of them; the first is the prior assumption.
KINDS = (
    Shadowing(sensor=0.4, place=0.4, range_m=60.0),
    *(
        Shadowing(sensor=sensor * (1 - fading), place=(1 - sensor) * (1 - fading), range_m=range_m)
        for sensor in (0.2, 0.6)
        for range_m in (50.0, 150.0)
        for fading in (0.02, 0.2)
    ),
    # Mainly a sensor's own excess, and mainly fading.
    Shadowing(sensor=0.996, place=0.002, range_m=60.0),
    Shadowing(sensor=0.9, place=0.08, range_m=60.0),
    Shadowing(sensor=0.4, place=0.2, range_m=60.0),
    Shadowing(sensor=0.05, place=0.05, range_m=60.0),
)
