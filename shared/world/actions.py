"""A UAV's action in one step: the sensor that it collects from, and its velocity."""

from typing import NamedTuple


class Action(NamedTuple):
    """A sensor's ID and a velocity in m/s. An action equals the plain pair, and is stored and sent as a pair."""

    sensor_id: int
    velocity: int
