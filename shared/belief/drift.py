"""The drift of a fleet: the true distances flown, learned from the UAVs' reported progress and top speeds."""

from collections.abc import Collection
from typing import Any

import numpy as np

from shared.world.channel import FloatArray
from shared.world.trajectory import Trajectory

# The largest insignificant drift, as a share of the way; the weight of the prior (no drift) in steps; and the factor by
# which older steps' weight decays.
_NOTHING = 1e-6
_PRIOR_STEPS = 1.0
_KEPT = 0.97
# Metres of still air of one step of the integration.
_STRIDE_M, _MOST_STRIDES = 50.0, 512
_SLOWEST, _FASTEST = 0.1, 2.0
_BRAKING_M = 40.0


class Drift:
    """The wind's part of a UAV's way: it flies ``v dt (1 + w . h)`` along the heading h, a unit vector.

    ``w``, ``(2,)``, is the least-squares estimate of all UAVs' steps, shrunk towards 0; older steps count less.

    Attributes:
        tops: by UAV, the highest velocity that it reaches, m/s, of the UAVs that have reported one.
    """

    def __init__(self) -> None:
        self._normal: FloatArray = np.eye(2) * _PRIOR_STEPS
        self._moment: FloatArray = np.zeros(2)
        self.none = True
        self.tops: dict[int, int] = {}

    def fastest(self, uavs: Collection[int], limit: int) -> int:
        """The highest velocity that one of these UAVs reaches, m/s, at most ``limit``."""
        return min(limit, max((self.tops.get(uav, limit) for uav in uavs), default=limit))

    @property
    def wind(self) -> FloatArray:
        """``w``, shape ``(2,)``: east and north, as a share of the commanded way."""
        return np.asarray(np.linalg.solve(self._normal, self._moment))

    def learn(self, path: Trajectory, start_m: float, still_m: float, end_m: float) -> None:
        """Learn from one step of a UAV.

        Args:
            start_m: progress at its start, metres.
            still_m: the commanded way ``v dt``, metres.
            end_m: progress at its end, metres.
        """
        # An airframe with a top speed needs some way to slow down, so that a short one says nothing of the wind.
        if still_m <= (_BRAKING_M if self.tops else 0.0):
            return
        # Progress may restart with every lap, of which a long step has several, and shakes where a UAV hovers.
        flown_m = end_m - start_m
        flown_m += round((still_m - flown_m) / path.length_m) * path.length_m
        share = min(max(flown_m / still_m, 0.0), _FASTEST) - 1.0
        if self.none and abs(share) <= _NOTHING:
            return
        self.none = False
        heading = _headings(path, np.array([start_m + still_m / 2]))[0]
        self._normal = _KEPT * self._normal + (1 - _KEPT) * np.eye(2) * _PRIOR_STEPS + np.outer(heading, heading)
        self._moment = _KEPT * self._moment + heading * share

    def flown(self, path: Trajectory, start_m: float, still_m: FloatArray) -> FloatArray:
        """The metres flown, shape ``(n,)``, for commanded ways ``(n,)`` from a progress on."""
        if self.none or not len(still_m):
            return still_m
        wind, at = self.wind, [0.0]
        stride = max(_STRIDE_M, float(still_m.max()) / _MOST_STRIDES)
        strides = int(np.ceil(float(still_m.max()) / stride)) + 1
        for _ in range(strides):
            heading = _headings(path, np.array([start_m + at[-1] + stride / 2]))[0]
            at.append(at[-1] + stride * min(max(1.0 + float(heading @ wind), _SLOWEST), _FASTEST))
        return np.asarray(np.interp(still_m, np.arange(strides + 1) * stride, at))

    def state_dict(self) -> dict[str, Any]:
        """The estimate, as copies."""
        learned = {"normal": self._normal.copy(), "moment": self._moment.copy(), "none": self.none}
        return learned | {"tops": self.tops.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self._normal, self._moment, self.none = state["normal"], state["moment"], state["none"]
        self.tops = dict(state.get("tops", {}))


def _headings(path: Trajectory, progress_m: FloatArray) -> FloatArray:
    """Unit vectors along a trajectory at progresses ``(n,)``: ``(n, 2)``."""
    chord = path.at(progress_m + 0.5) - path.at(progress_m - 0.5)
    return np.asarray(chord / np.maximum(np.hypot(chord[:, 0], chord[:, 1]), 1e-9)[:, None])
