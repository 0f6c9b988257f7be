"""A UAV's position, its current decision, and its last flown decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from shared.belief.drift import Drift
from shared.world.channel import FloatArray
from shared.world.scenario import Point
from shared.world.trajectory import Trajectory


@dataclass(slots=True)
class Visit:
    """A flown decision: the sensor, the velocity, where the UAV started, and what was believed of the sensor before.

    ``collected`` says whether the belief has taken packets from the sensor, and ``failed`` is the UAV's report,
    ``None`` before it.
    """

    step: int
    sensor: int
    base: float
    since: int
    visited: int
    collected: bool
    failed: bool | None
    velocity: int
    start_m: float | None


@dataclass(slots=True)
class Whereabouts:
    """A UAV's position at the start of ``step``, its decision in that step, if known, and its last flown one.

    ``progress_m`` along its trajectory is ``None`` for a UAV off its trajectory, which is assumed to stay in place.
    ``failed`` is the reported outcome of ``action``, ``None`` before the report. ``taught`` is the step of the newest
    report from which channel and drift have learned: a repeated report is ignored.
    """

    step: int
    position: Point
    progress_m: float | None
    action: tuple[int, int] | None = None
    failed: bool | None = None
    visit: Visit | None = None
    taught: int = -1

    def ahead(self, path: Trajectory, drift: Drift, metres: ArrayLike) -> FloatArray:
        """The UAV's places, ``(n, 2)``, after it has flown ``metres`` ``(n,)`` on along its trajectory."""
        flown = np.asarray(metres, dtype=np.float64)
        if self.progress_m is None:
            return np.broadcast_to(np.asarray(self.position), (len(flown), 2))
        return path.at(self.progress_m + drift.flown(path, self.progress_m, flown))

    def state(self) -> list[Any]:
        """The attributes, as plain values."""
        visit = None if self.visit is None else astuple(self.visit)
        return [self.step, list(self.position), self.progress_m, self.action, self.failed, visit, self.taught]

    @classmethod
    def of(cls, state: Sequence[Any]) -> Self:
        """From such a state; one of an earlier version ends with the action."""
        step, (x, y), progress_m, action, failed, visit, taught = (*state, None, None, -1)[:7]
        return cls(
            step=step,
            position=(x, y),
            progress_m=progress_m,
            action=None if action is None else (action[0], action[1]),
            failed=failed,
            visit=None if visit is None else Visit(*visit),
            taught=taught,
        )
