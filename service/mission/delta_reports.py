"""Delta encoding of reports: a report may leave out what the UAV's reference report or an earlier report has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import Incomplete, Refused
from shared.channel import FloatArray
from shared.wire import SensorColumns, UavState

AnyReport = TypeVar("AnyReport", bound=UavState)

# The columns of a reference report, in this order.
_COLUMNS = ("id", "queue", "battery", "channel_gain", "last_seen")


@dataclass(frozen=True, slots=True)
class ReferenceReport:
    """A report of n sensors that ``decision_id`` answered.

    ``columns`` has shape ``(5, n)``, NaN for null. A float64 represents every number of the wire exactly.
    """

    decision_id: str
    step: int
    columns: FloatArray


class DeltaReports:
    """The last report of each UAV that uses the uplink ``delta``, as the reference for its next one.

    The references are in memory only, 40 bytes a sensor. After the loss of the process or the mission a UAV sends a
    full report again.
    """

    def __init__(self) -> None:
        self._references: dict[int, ReferenceReport] = {}

    def remember(self, uav: UavState, step: int, decision_id: str) -> None:
        """Make an answered report the UAV's reference; without an uplink in the report the UAV has none."""
        if uav.uplink is None:
            self._references.pop(uav.uav_id, None)
            return
        self._references[uav.uav_id] = ReferenceReport(decision_id, step, _array(uav.sensors))

    def complete(self, uav: AnyReport, step: int, positions: FloatArray, at: str = "") -> AnyReport:
        """The report in full. A report that leaves nothing out is returned unchanged.

        Args:
            positions: the latest known positions of the mission's sensors, ``(J, 2)`` metres, NaN where unknown. The
                report names no other sensors.
            at: the path of the UAV in the request's body, such as ``uavs[1].``.

        Raises:
            Incomplete: the edge has no such reference report, or does not know a sensor's position.
            Refused: the report changes a sensor that its reference lacks, or the reference is later than the step.
        """
        changed = uav.sensors
        if uav.base is None:
            if changed.x:
                return uav
            x, y = _positions_of(np.asarray(changed.id), positions, at)
            return uav.model_copy(update={"sensors": changed.model_copy(update={"x": x.tolist(), "y": y.tolist()})})
        columns = self._reference(uav, step, at).columns.copy()
        ids = columns[0].astype(np.int64)
        rows = _rows(ids, changed.id, at)
        columns[:, rows] = _array(changed)
        if changed.x:
            # A corrected survey moves a sensor.
            positions = positions.copy()
            positions[changed.id] = np.stack((changed.x, changed.y), axis=1)
        x, y = _positions_of(ids, positions, at)
        queue, battery, gain, seen = (_nullable(column) for column in columns[1:])
        # Validation is skipped: each number passed it when its report arrived.
        whole = SensorColumns.model_construct(
            id=ids.tolist(),
            x=x.tolist(),
            y=y.tolist(),
            queue=queue,
            battery=battery,
            channel_gain=gain,
            last_seen=[None if step is None else int(step) for step in seen],
        )
        return uav.model_copy(update={"base": None, "uplink": "delta", "sensors": whole})

    def _reference(self, uav: UavState, step: int, at: str) -> ReferenceReport:
        reference = self._references.get(uav.uav_id)
        if reference is None or reference.decision_id != uav.base:
            raise Incomplete(
                f"{at}base",
                f"the edge has no report of UAV {uav.uav_id} that decision {uav.base} answered: send a full report",
            )
        if reference.step > step:
            raise Refused(f"{at}base", f"decision {uav.base} is of step {reference.step}, later than this step {step}")
        return reference


def _array(sensors: SensorColumns) -> FloatArray:
    # numpy makes NaN of None.
    return np.array([getattr(sensors, name) for name in _COLUMNS], dtype=np.float64)


def _rows(ids: NDArray[np.int64], changed: list[int], at: str) -> NDArray[np.int64]:
    """Rows of the changed sensors in the reference report."""
    wanted = np.asarray(changed, dtype=np.int64)
    order = np.argsort(ids)
    found: NDArray[np.int64] = order[np.searchsorted(ids, wanted, sorter=order).clip(max=len(ids) - 1)]
    if (missing := np.flatnonzero(ids[found] != wanted)).size:
        sensor = wanted[missing[0]]
        raise Refused(f"{at}sensors.id", f"sensor {sensor} is not in the report that `base` names: send a full report")
    return found


def _positions_of(ids: NDArray[np.int64], positions: FloatArray, at: str) -> FloatArray:
    """Coordinates of these sensors, ``(2, n)``."""
    found = positions[ids].T
    if (unknown := np.flatnonzero(np.isnan(found[0]))).size:
        raise Incomplete(f"{at}sensors.x", f"the position of sensor {ids[unknown[0]]} is unknown: send x and y")
    return found


def _nullable(column: FloatArray) -> list[float | None]:
    return [None if value != value else value for value in column.tolist()]
