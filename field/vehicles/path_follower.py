"""Where along its trajectory a UAV is."""

from __future__ import annotations

import numpy as np

from shared.world.scenario import Point
from shared.world.trajectory import Trajectory

# A UAV may be this far from where its speed would have brought it, metres: wind, turns, the error of a position.
SLACK_M = 50.0
_SAMPLE_M = 1.0
_MOST_SAMPLES = 5000


class PathFollower:
    """Follows one UAV along its trajectory.

    A trajectory may pass a place twice, on the ways there and back for instance. So a position is looked for between
    the last one and the farthest that the UAV can have come, and on the whole trajectory only if it is not near that.

    Args:
        trajectory: of the UAV.
        top_speed_m_s: of the UAV.

    Attributes:
        progress_m: arc length from the trajectory's beginning; ``None`` before the first position.
    """

    def __init__(self, trajectory: Trajectory, top_speed_m_s: float) -> None:
        self._trajectory, self._top_speed_m_s = trajectory, top_speed_m_s
        self.progress_m: float | None = None

    def follow(self, position: Point, seconds: float) -> float:
        """Take a position that many seconds after the last one; returns its distance from the trajectory, metres."""
        if self.progress_m is not None:
            first = max(0.0, self.progress_m - SLACK_M)
            last = self.progress_m + self._top_speed_m_s * seconds + SLACK_M
            count = min(_MOST_SAMPLES, int((last - first) / _SAMPLE_M) + 2)
            along = np.linspace(first, last, count)
            gaps = np.hypot(*(self._trajectory.at(along) - position).T)
            nearest = int(np.argmin(gaps))
            if gaps[nearest] <= SLACK_M:
                self.progress_m = float(along[nearest])
                return float(gaps[nearest])
        self.progress_m, gap = self._trajectory.locate(position)
        return gap

    def ahead(self, metres: float) -> Point:
        """The point of the trajectory that many metres ahead."""
        x, y = self._trajectory.at((self.progress_m or 0.0) + metres).tolist()
        return x, y
