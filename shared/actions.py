"""What a UAV does in one step: the sensor that it collects from, and the velocity that it flies at."""

from __future__ import annotations

from typing import NamedTuple


class Action(NamedTuple):
    """A sensor's ID and a velocity in m/s. It is equal to the plain pair, and stored and sent as one."""

    sensor_id: int
    velocity: int
