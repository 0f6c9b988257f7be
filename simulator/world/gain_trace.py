"""A recorded gain trace: the excess loss of a UAV's links along the way that it flies."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shared.world.channel import FloatArray
from shared.world.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class GainTrace:
    """Measured excess losses by UAV and sensor.

    Attributes:
        points: by UAV and sensor, the arc lengths along the UAV's trajectory, ascending, metres, and the excess losses
            there, dB, each ``(n,)`` with n at least 1. A pair that is absent has no excess loss.
    """

    points: Mapping[tuple[int, int], tuple[FloatArray, FloatArray]]

    def excess_db(self, progress_m: FloatArray, paths: Sequence[Trajectory], sensors: int) -> FloatArray:
        """The excess losses of UAVs at progress ``(..., I)``, metres, to every sensor, ``(..., I, J)``, dB.

        Between two points it is interpolated linearly, and between the last and the first around the trajectory.
        """
        excess = np.zeros((*progress_m.shape, sensors))
        for (uav, sensor), (along, loss) in self.points.items():
            excess[..., uav, sensor] = np.interp(progress_m[..., uav], along, loss, period=paths[uav].length_m)
        return excess
