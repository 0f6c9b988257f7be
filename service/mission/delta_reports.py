"""What a report may leave out: what the UAV's last one said, held for those that ask for it, and places told before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import Incomplete, Refused
from shared.channel import FloatArray
from shared.wire import SensorColumns, UavState

AnyReport = TypeVar("AnyReport", bound=UavState)

# The columns of a base, in this order.
_COLUMNS = ("id", "queue", "battery", "channel_gain", "last_seen")


@dataclass(frozen=True, slots=True)
class Base:
    """One report of n sensors: ``columns`` ``(5, n)``, NaN for null; every number of the wire fits exactly."""

    decision_id: str
    step: int
    columns: FloatArray


class DeltaBases:
    """The last report of each UAV that asks for it, by what it was told then.

    In memory only, 40 bytes a sensor: what is lost with the process, or the mission, the UAV tells anew.
    """

    def __init__(self) -> None:
        self._held: dict[int, Base] = {}

    def hold(self, uav: UavState, step: int, decision_id: str) -> None:
        """Hold a report that was answered, in place of this UAV's last; or none, where it does not ask for it."""
        if uav.uplink is None:
            self._held.pop(uav.uav_id, None)
            return
        self._held[uav.uav_id] = Base(decision_id, step, _array(uav.sensors))

    def complete(self, uav: AnyReport, step: int, places: FloatArray, at: str = "") -> AnyReport:
        """The report in full; as it is, where it leaves nothing out.

        Args:
            places: of the mission's sensors as last told, ``(J, 2)`` metres, NaN where nobody has. The report names
                no others.
            at: where in the request's body this UAV stands, such as ``uavs[1].``.

        Raises:
            Incomplete: what it leaves out is not held.
            Refused: it changes a sensor that its base does not name, or its base is later than the step.
        """
        news = uav.sensors
        if uav.base is None:
            if news.x:
                return uav
            x, y = _placed(np.asarray(news.id), places, at)
            return uav.model_copy(update={"sensors": news.model_copy(update={"x": x.tolist(), "y": y.tolist()})})
        columns = self._based(uav, step, at).columns.copy()
        ids = columns[0].astype(np.int64)
        rows = _rows(ids, news.id, at)
        columns[:, rows] = _array(news)
        if news.x:
            # Told anew, as a survey that was corrected would be.
            places = places.copy()
            places[news.id] = np.stack((news.x, news.y), axis=1)
        x, y = _placed(ids, places, at)
        queue, battery, gain, seen = (_nullable(column) for column in columns[1:])
        # Each number was checked when it came in.
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

    def _based(self, uav: UavState, step: int, at: str) -> Base:
        base = self._held.get(uav.uav_id)
        if base is None or base.decision_id != uav.base:
            raise Incomplete(
                f"{at}base", f"the report of UAV {uav.uav_id} that decision {uav.base} answered is not held: send all"
            )
        if base.step > step:
            raise Refused(f"{at}base", f"decision {uav.base} is of step {base.step}, later than this step {step}")
        return base


def _array(sensors: SensorColumns) -> FloatArray:
    # numpy makes NaN of None.
    return np.array([getattr(sensors, name) for name in _COLUMNS], dtype=np.float64)


def _rows(ids: NDArray[np.int64], changed: list[int], at: str) -> NDArray[np.int64]:
    """Where in the base the sensors stand that changed."""
    wanted = np.asarray(changed, dtype=np.int64)
    order = np.argsort(ids)
    found: NDArray[np.int64] = order[np.searchsorted(ids, wanted, sorter=order).clip(max=len(ids) - 1)]
    if (missing := np.flatnonzero(ids[found] != wanted)).size:
        sensor = wanted[missing[0]]
        raise Refused(f"{at}sensors.id", f"sensor {sensor} is not in the report that `base` names: send all")
    return found


def _placed(ids: NDArray[np.int64], places: FloatArray, at: str) -> FloatArray:
    """Their places, ``(2, n)``."""
    found = places[ids].T
    if (unknown := np.flatnonzero(np.isnan(found[0]))).size:
        raise Incomplete(f"{at}sensors.x", f"the place of sensor {ids[unknown[0]]} was never told: send x and y")
    return found


def _nullable(column: FloatArray) -> list[float | None]:
    return [None if value != value else value for value in column.tolist()]
