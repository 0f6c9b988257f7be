"""The beacons that the UAVs of one world heard."""

from __future__ import annotations

import numpy as np

from shared.world.channel import FloatArray, IntArray, Links
from simulator.world.sensors import Sensors


class Beacons:
    """The last beacon of each sensor that each UAV heard; zeros, and step -1, for a sensor never heard.

    Attributes:
        queue: shape ``(I, J)``, packets.
        battery: shape ``(I, J)``, joules.
        gain_db: shape ``(I, J)``, of the link to the UAV.
        step: shape ``(I, J)``, of the beacon.
    """

    def __init__(self, uavs: int, sensors: int) -> None:
        self.queue: FloatArray = np.zeros((uavs, sensors))
        self.battery: FloatArray = np.zeros((uavs, sensors))
        self.gain_db: FloatArray = np.zeros((uavs, sensors))
        self.step: IntArray = np.full((uavs, sensors), -1)

    def hear(self, step: int, sensors: Sensors, links: Links, radius_m: float) -> None:
        """Replace the beacons of the sensors within the radio radius by their current ones."""
        heard = links.distance_m <= radius_m
        self.queue = np.where(heard, sensors.queue, self.queue)
        self.battery = np.where(heard, sensors.battery, self.battery)
        self.gain_db = np.where(heard, links.gain_db, self.gain_db)
        self.step = np.where(heard, step, self.step)
