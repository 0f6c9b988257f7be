"""Sensors' own readings: each is checked, placed in a step of its mission by its age, and merged once."""

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from service.errors import Refused
from shared.belief.fleet_belief import FleetBelief
from shared.belief.records import Records, take_readings
from shared.wire.readings import ReadingResult, SensorReading
from shared.world.scenario import Scenario


class PlacedReading(NamedTuple):
    """A sensor's reading at the start of a step, negative before the mission's first; ``battery`` in J, if known."""

    sensor_id: int
    step: int
    queue: float
    battery: float | None
    message_id: str | None


class Readings:
    """The readings of one mission's sensors.

    Attributes:
        merged: the number of readings that changed the belief.
        began: the newest step that a UAV has reported, and the time of its first report by ``time.monotonic``. Ages
            count back from then.
    """

    def __init__(self, scenario: Scenario, belief: FleetBelief, records: Records) -> None:
        self._scenario = scenario
        self._belief = belief
        self._records = records
        self.merged = 0
        # By sensor: an older message would be outdated anyway.
        self._messages: dict[int, str] = {}
        self.began = -1, 0.0

    def placed(self, given: Sequence[SensorReading]) -> list[PlacedReading] | None:
        """The readings with their steps; None before the mission's first report.

        A reading within step n, after the fleet's first report of it, counts as of the start of step n: the queue has
        the arrivals since then too, and a visit of step n takes its packets later.

        Raises:
            Refused: an unknown sensor, a queue past its capacity, or a step later than the mission's newest.
        """
        scenario, newest = self._scenario, self._belief.newest
        for index, reading in enumerate(given):
            at = f"readings[{index}]"
            if reading.sensor_id >= scenario.sensors:
                raise Refused(
                    f"{at}.sensor_id", f"sensor {reading.sensor_id} is unknown: there are {scenario.sensors}, from 0"
                )
            if reading.queue > scenario.queue_capacity:
                raise Refused(
                    f"{at}.queue", f"{reading.queue:g} packets exceed the capacity of {scenario.queue_capacity}"
                )
            if newest is not None and reading.step is not None and reading.step > newest:
                raise Refused(f"{at}.step", f"step {reading.step} is later than {newest}, the mission's newest")
        if newest is None:
            return None
        # After a restart the newest step is taken to begin now.
        step, at_s = self.began
        since_began_s = time.monotonic() - at_s if step == newest else 0.0
        return [
            PlacedReading(r.sensor_id, self._step_of(r, newest, since_began_s), r.queue, r.battery, r.message_id)
            for r in given
        ]

    def _step_of(self, reading: SensorReading, newest: int, since_began_s: float) -> int:
        if reading.step is not None:
            return reading.step
        assert reading.age_s is not None
        return newest + min(0, math.floor((since_began_s - reading.age_s) / self._scenario.step_s))

    def take(self, readings: Sequence[PlacedReading]) -> list[ReadingResult]:
        """Merge the readings into records and belief; returns the result of each."""
        fresh = [r.message_id is None or self._messages.get(r.sensor_id) != r.message_id for r in readings]
        unknown = [reading for reading, new in zip(readings, fresh, strict=True) if new]
        news = take_readings(
            np.array([r.sensor_id for r in unknown], dtype=np.int64),
            np.array([r.step for r in unknown], dtype=np.int64),
            np.array([r.queue for r in unknown], dtype=np.float64),
            # numpy converts None to NaN.
            np.array([r.battery for r in unknown], dtype=np.float64),
            self._records,
            self._belief,
        )
        self.merged += int(news.sum())
        for reading, merged in zip(unknown, news.tolist(), strict=True):
            if merged and reading.message_id is not None:
                self._messages[reading.sensor_id] = reading.message_id
        taken = iter(news.tolist())
        return [("merged" if next(taken) else "outdated") if new else "duplicate" for new in fresh]

    def state_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"merged": self.merged, "messages": dict(self._messages)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.merged, self._messages = state["merged"], dict(state["messages"])
