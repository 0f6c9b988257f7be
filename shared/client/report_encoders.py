"""Encoders of a UAV's reports: the full report, or its changes since the last answered one."""

from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel

from shared.wire.schemas import DecideResponse, SensorColumns, UavState

Report = TypeVar("Report", bound=UavState)


@dataclass(frozen=True)
class Fetch:
    """A resource that a UAV needs before it can reduce its report; ``etag`` is that of its cached copy."""

    path: str
    model: type[BaseModel]
    etag: str | None = None


class FullReports:
    """Uplink ``full``: every report in full. Encoders of the other uplinks send a full report after ``forget``."""

    def next_fetch(self, mission_id: str, step: int, uav_id: int) -> Fetch | None:
        """The next resource to fetch before encoding; ``None`` once all are there."""
        return None

    def store(self, uav_id: int, step: int, fetched: BaseModel | None, etag: str | None) -> None:
        """Use a fetched resource; ``None`` means that it has not changed."""

    def encode(self, mission_id: str, step: int, uav: Report) -> Report:
        """The part of a full report to send."""
        return uav

    def record_answer(self, uav: UavState, response: DecideResponse) -> None:
        """The edge decided on this report and can complete it; ``uav`` is the full report, whatever part was sent."""

    def forget(self, uav_id: int) -> None:
        """The edge lost the earlier reports: the next report is sent in full."""


class DeltaReports(FullReports):
    """Uplink ``delta``: the sensors that changed since this UAV's last answered report, without their positions.

    The encoder stores one report a UAV, that of the UAV's latest mission.
    """

    def __init__(self) -> None:
        self._references: dict[int, tuple[SensorColumns, DecideResponse]] = {}

    def encode(self, mission_id: str, step: int, uav: Report) -> Report:
        """The changed rows; the full report without a reference report, or after sensors or positions changed."""
        now = uav.sensors
        old, answer = self._references.get(uav.uav_id, (None, None))
        if (
            old is None
            or answer is None
            or answer.mission_id != mission_id
            or answer.step > step
            or (old.id, old.x, old.y) != (now.id, now.x, now.y)
        ):
            return uav.model_copy(update={"uplink": "delta"})
        before = zip(old.queue, old.battery, old.channel_gain, old.last_seen, strict=True)
        after = zip(now.queue, now.battery, now.channel_gain, now.last_seen, strict=True)
        changed = [row for row, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
        return uav.model_copy(update={"base": answer.decision_id, "sensors": without_positions(now, changed)})

    def record_answer(self, uav: UavState, response: DecideResponse) -> None:
        """Use it as the reference of the next report."""
        self._references[uav.uav_id] = uav.sensors, response

    def forget(self, uav_id: int) -> None:
        """Send the next report in full."""
        self._references.pop(uav_id, None)


def without_positions(sensors: SensorColumns, rows: list[int]) -> SensorColumns:
    """Some rows of a report, without their positions."""
    return SensorColumns.model_construct(
        id=[sensors.id[row] for row in rows],
        queue=[sensors.queue[row] for row in rows],
        battery=[sensors.battery[row] for row in rows],
        channel_gain=[sensors.channel_gain[row] for row in rows],
        last_seen=[sensors.last_seen[row] for row in rows],
    )
