"""A decision's deadline, and the duration of each of its stages."""

import time
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, order=True)
class Deadline:
    """A moment of ``time.perf_counter``, in seconds."""

    at: float

    def left(self) -> float:
        """Seconds from now, 0 once the deadline has passed."""
        return max(0.0, self.at - time.perf_counter())


@dataclass(slots=True)
class Stopwatch:
    """When a request arrived, and when the stages of its decision ended; moments of ``time.perf_counter``.

    Attributes:
        ended: each stage, or a further part of it, and its end, in order; the next stage begins there.
    """

    started: float = field(default_factory=time.perf_counter)
    ended: list[tuple[str, float]] = field(default_factory=list)

    def milliseconds(self, now: float) -> dict[str, float]:
        """By stage, and in total until now."""
        last, stages = self.started, dict[str, float]()
        for stage, end in self.ended:
            stages[stage] = stages.get(stage, 0.0) + (end - last) * 1e3
            last = end
        return {name: round(taken, 3) for name, taken in (*stages.items(), ("total", (now - self.started) * 1e3))}
