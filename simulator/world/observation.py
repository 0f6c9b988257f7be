"""A UAV's observation of the world, and the result of a step of the fleet."""

from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray

Cost = Literal["default", "paper"]


class Observation(TypedDict):
    """The observation of one UAV; shapes and units are in :class:`~simulator.world.environment.PipelineWorld`."""

    step: IntArray
    position: FloatArray
    progress: FloatArray
    sensor_position: FloatArray
    queue: FloatArray
    battery: FloatArray
    channel_gain: FloatArray
    last_heard: IntArray


class Info(TypedDict):
    """The outcome of one UAV's last action; see :class:`~simulator.world.environment.PipelineWorld`."""

    action_mask: NDArray[np.int8]
    failed: bool
    collected: int
    lost_packets: int
    cost: float


@dataclass(frozen=True, eq=False)
class StepTally:
    """One step of the whole fleet: the two losses of the paper's P_l, the packets lost, and those collected.

    ``failures`` is the sum of f over UAVs, ``overflows`` the sum of g over sensors, ``collected`` has shape ``(J,)``.
    """

    step: int
    failures: int
    overflows: int
    lost_packets: int
    collected: IntArray

    @property
    def events(self) -> int:
        """The paper's loss P_l of the step: failed transmissions plus overflowing sensors."""
        return self.failures + self.overflows
