"""A moment until which something may take its time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True, slots=True, order=True)
class Deadline:
    """A moment of ``time.perf_counter``, in seconds."""

    at: float

    @classmethod
    def after(cls, milliseconds: float, since: float) -> Self:
        """So many milliseconds after a moment of ``time.perf_counter``."""
        return cls(since + milliseconds / 1e3)

    def left(self) -> float:
        """Seconds from now, 0 once the deadline has passed."""
        return max(0.0, self.at - time.perf_counter())

    def earlier_by(self, seconds: float) -> Deadline:
        """The deadline with so many seconds kept back."""
        return Deadline(self.at - seconds)
