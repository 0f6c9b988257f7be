"""Sensors that report to the edge themselves, over a network on the ground such as LoRaWAN."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from shared.client.edge_client import EdgeClient
from shared.wire.readings import MAX_READINGS, ReadingsRequest, SensorReading
from shared.world.scenario import Scenario
from simulator.records.decision import Record

# The world takes a second to import; the experiments' `--help` does without it.
if TYPE_CHECKING:
    from simulator.world.sensors import Sensors


class UplinkPlan(Record):
    """The share of sensors that report, and the steps between two reports of one sensor."""

    share: float
    every: int


class SensorUplinks:
    """The reports of a mission's sensors to its edge.

    The seed draws the sensors that report, and for each the step of its first report, before its second could be due.
    A reading is sent once the fleet has its decisions of the step, so that decisions of the next step are the first to
    use it.

    Raises (``send``):
        EdgeError: the edge did not take the readings.
    """

    def __init__(self, client: EdgeClient, mission_id: str, scenario: Scenario, seed: int, plan: UplinkPlan) -> None:
        self._client = client
        self._mission_id = mission_id
        self._every = plan.every
        draws = np.random.default_rng([seed, *b"sensor uplinks"])
        self._sensors = np.sort(draws.permutation(scenario.sensors)[: round(plan.share * scenario.sensors)])
        self._first = draws.integers(plan.every, size=len(self._sensors))

    def send(self, step: int, sensors: Sensors) -> None:
        """Send the readings of the sensors that report in a step, with their queues at its start."""
        due = self._sensors[(step - self._first) % self._every == 0]
        readings = [
            SensorReading(
                sensor_id=int(sensor),
                queue=float(sensors.queue[sensor]),
                battery=float(sensors.battery[sensor]),
                step=step,
                message_id=f"{sensor}-{step}",
            )
            for sensor in due
        ]
        for start in range(0, len(readings), MAX_READINGS):
            request = ReadingsRequest(readings=readings[start : start + MAX_READINGS])
            self._client.send_readings(self._mission_id, request)
