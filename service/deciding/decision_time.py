"""A decision's time: the deadline until which a stage may take, and what each stage took."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, order=True)
class Deadline:
    """A moment of ``time.perf_counter``, in seconds."""

    at: float

    def left(self) -> float:
        """Seconds from now, 0 once the deadline has passed."""
        return max(0.0, self.at - time.perf_counter())

    def earlier_by(self, seconds: float) -> Deadline:
        """The deadline with so many seconds kept back."""
        return Deadline(self.at - seconds)


@dataclass(slots=True)
class Stopwatch:
    """Milliseconds by stage since the request arrived."""

    started: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """End a stage, or a further part of it."""
        now = time.perf_counter()
        self.stages[stage] = round(self.stages.get(stage, 0.0) + (now - self._last) * 1e3, 3)
        self._last = now

    def total(self) -> dict[str, float]:
        """The stages and their total."""
        return {**self.stages, "total": round((time.perf_counter() - self.started) * 1e3, 3)}
