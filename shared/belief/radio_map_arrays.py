"""The arrays of a radio map."""

from typing import NamedTuple

from shared.world.channel import FloatArray, IntArray

# The numbers of a measurement: the UAV's place, the excess loss, the noise and when it was taken, and its entries of
# K^-1 r and K^-1 1.
EAST, NORTH, EXCESS, NOISE, TAKEN, MEASURED, ONES, NUMBERS = range(8)


class Measurements(NamedTuple):
    """The measurements of J sensors, at most N of each.

    Attributes:
        kept: shape ``(J, N, 7)``, the numbers of each.
        counts: shape ``(J,)``, how many a sensor has.
        inverse: ``K^-1`` of each sensor, shape ``(J, N (N + 1) / 2)``: the upper triangle column by column, in half the
            memory, so that a leading block comes first; zeros where there is no measurement. ``(0, 0)`` as long as
            every measurement agrees with the formula.
        work: shape ``(3, N)``, any numbers.
    """

    kept: FloatArray
    counts: IntArray
    inverse: FloatArray
    work: FloatArray


class LinkStatistics(NamedTuple):
    """The statistics of all links.

    The first four are of the kind of :class:`~shared.belief.shadowing.Shadowing`, ``offset_db`` and ``deviation_db``
    ``mu`` and ``sigma``; ``heard`` counts the measurements of all sensors so far.
    """

    sensor: float
    place: float
    range_m: float
    fading: float
    offset_db: float
    deviation_db: float
    heard: int
