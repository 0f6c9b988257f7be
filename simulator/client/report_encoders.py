"""What of a UAV's report is sent: all of it, what changed since it was answered last, or the sensors worth it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel

from shared.wire import DecideResponse, SensorColumns, UavState

Told = TypeVar("Told", bound=UavState)


@dataclass(frozen=True)
class Fetch:
    """What a UAV needs of the edge before it can reduce its report; ``etag`` is of what it holds of it already."""

    path: str
    model: type[BaseModel]
    etag: str | None = None


class FullReports:
    """Uplink ``full``: every report as it is. What the other uplinks leave out they tell again once it is forgotten."""

    def missing(self, mission_id: str, step: int, uav_id: int) -> Fetch | None:
        """What is to be fetched first, one thing at a time."""
        return None

    def take(self, uav_id: int, step: int, told: BaseModel | None, etag: str | None) -> None:
        """What was fetched; ``None`` where it is as it was."""

    def reduced(self, mission_id: str, step: int, uav: Told) -> Told:
        """What to send of a full report."""
        return uav

    def answered(self, uav: UavState, response: DecideResponse) -> None:
        """The edge has this full report, whatever was sent of it, and decided."""

    def forget(self, uav_id: int) -> None:
        """The edge does not hold what it was told: the next report is sent in full."""


@dataclass(frozen=True)
class _Held:
    mission_id: str
    step: int
    decision_id: str
    sensors: SensorColumns


class DeltaReports(FullReports):
    """Uplink ``delta``: the sensors that changed since this UAV's last report that was answered, without their places.

    Kept of each UAV is one report, of the mission that it asked about last.
    """

    def __init__(self) -> None:
        self._held: dict[int, _Held] = {}

    def reduced(self, mission_id: str, step: int, uav: Told) -> Told:
        """The rows that changed; all of it where there is nothing to build on, or other sensors or places."""
        held, now = self._held.get(uav.uav_id), uav.sensors
        if (
            held is None
            or held.mission_id != mission_id
            or held.step > step
            or (held.sensors.id, held.sensors.x, held.sensors.y) != (now.id, now.x, now.y)
        ):
            return uav.model_copy(update={"uplink": "delta"})
        old = held.sensors
        before = zip(old.queue, old.battery, old.channel_gain, old.last_seen, strict=True)
        after = zip(now.queue, now.battery, now.channel_gain, now.last_seen, strict=True)
        changed = [row for row, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
        return uav.model_copy(update={"base": held.decision_id, "sensors": unplaced(now, changed)})

    def answered(self, uav: UavState, response: DecideResponse) -> None:
        """Build on it next time."""
        self._held[uav.uav_id] = _Held(response.mission_id, response.step, response.decision_id, uav.sensors)

    def forget(self, uav_id: int) -> None:
        """Tell all of it next time."""
        self._held.pop(uav_id, None)


def unplaced(sensors: SensorColumns, rows: list[int]) -> SensorColumns:
    """Some rows of a report, without their places."""
    return SensorColumns.model_construct(
        id=[sensors.id[row] for row in rows],
        queue=[sensors.queue[row] for row in rows],
        battery=[sensors.battery[row] for row in rows],
        channel_gain=[sensors.channel_gain[row] for row in rows],
        last_seen=[sensors.last_seen[row] for row in rows],
    )
