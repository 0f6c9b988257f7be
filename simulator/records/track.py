"""The true state of a flight over its steps, for the report's playback."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The most numbers of a playback; scenario `paper` has some 2,000, and a number is some three bytes of a report.
MOST_NUMBERS = 300_000
# Those of a UAV at one instant: its place and its decision.
_NUMBERS_A_UAV = 10


@dataclass(frozen=True, eq=False)
class Instant:
    """The state after ``step`` steps.

    Attributes:
        positions: of each UAV that flies, as it reports them, metres.
        queue: ``(J,)``, packets waiting.
        battery: ``(J,)``, joules left.
        lost: ``(J,)``, packets that each sensor has lost since the start.
    """

    step: int
    positions: Mapping[int, tuple[float, float]]
    queue: NDArray[np.int64]
    battery: NDArray[np.float64]
    lost: NDArray[np.int64]


class Track:
    """The instants of a flight in the order of their steps, bounded in size.

    A flight that is too large keeps the start, every ``stride``-th step and the last one. ``stride`` is a power of 2.
    """

    def __init__(self) -> None:
        self.stride = 1
        self._kept: list[Instant] = []
        self._last: Instant | None = None

    def append(self, instant: Instant) -> None:
        """Add the state after one step more."""
        self._last = instant
        if instant.step % self.stride == 0:
            self._kept.append(instant)
        numbers = 3 * len(instant.queue) + _NUMBERS_A_UAV * len(instant.positions)
        while len(self._kept) > 2 and len(self._kept) * numbers > MOST_NUMBERS:
            self.stride *= 2
            self._kept = [kept for kept in self._kept if kept.step % self.stride == 0]

    def until(self, step: int) -> list[Instant]:
        """The instants kept, up to one step."""
        last = [] if self._last is None or self._last.step % self.stride == 0 else [self._last]
        return [instant for instant in (*self._kept, *last) if instant.step <= step]
