"""Reports: each is completed and checked against its mission's world before it changes anything.

A report may leave out what the UAV's reference report or an earlier report has (uplink ``delta``).
"""

import logging
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import Incomplete, Refused
from service.mission.decisions import MAX_STEPS_APART, PendingDecisions
from shared.belief.fleet_belief import FleetBelief
from shared.wire.schemas import SensorColumns, UavState
from shared.wire.sensor_arrays import arrays_of
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.trajectory import progress_of, trajectories

AnyReport = TypeVar("AnyReport", bound=UavState)
log = logging.getLogger(__name__)

# The columns of a reference report, in this order.
_COLUMNS = ("id", "queue", "battery", "channel_gain", "last_seen")
# A UAV and its sensors within so many metres of each other are a pipeline in degrees.
_DEGREES_APART = 2.0
# A report of step 0 after more steps is no late one: its fleet begins again, and the belief is that of later steps.
_STEPS_BACK = 3


@dataclass(frozen=True, slots=True)
class ReferenceReport:
    """A report of n sensors that ``decision_id`` answered.

    ``columns`` has shape ``(5, n)``, NaN for null. A float64 represents every number of the wire exactly.
    """

    decision_id: str
    step: int
    columns: FloatArray


class Reports:
    """Completes and checks a mission's reports; the last one of each UAV with the uplink ``delta`` is its reference.

    The references are in memory only, 40 bytes a sensor. After the loss of the process or the mission a UAV sends a
    full report again.
    """

    def __init__(self, mission_id: str, scenario: Scenario, belief: FleetBelief, pending: PendingDecisions) -> None:
        self._mission_id = mission_id
        self._scenario = scenario
        self._belief = belief
        self._pending = pending
        self._references: dict[int, ReferenceReport] = {}

    def complete(self, report: AnyReport, step: int, at: str = "") -> AnyReport:
        """The complete report, checked against the mission's world.

        Args:
            at: the path of the UAV in the request's body, such as ``uavs[1].``.

        Raises:
            Refused: a step far past the newest one, an unknown UAV or sensor, positions in degrees, a queue past its
                capacity, a beacon later than the step, an outcome of another UAV's decision, a change of a sensor that
                the reference lacks, or a reference later than the step.
            Incomplete: the edge has no such reference report, or does not know a sensor's position.
            NotFound: an outcome of a decision that the mission does not know.
        """
        scenario = self._scenario
        self._check_step(step)
        if report.uav_id >= scenario.uavs:
            raise Refused(f"{at}uav_id", f"UAV {report.uav_id} is unknown: this mission has {scenario.uavs}, from 0")
        if (highest := max(report.sensors.id, default=0)) >= scenario.sensors:
            raise Refused(f"{at}sensors.id", f"sensor {highest} is unknown: there are {scenario.sensors}, from 0")
        self._check_metres(report, at)
        if report.base is not None or not report.sensors.x:
            report = self._in_full(report, step, at)
        sensors = arrays_of(report.sensors)
        if (fullest := np.maximum.reduce(sensors.queue, initial=0.0)) > scenario.queue_capacity:
            raise Refused(f"{at}sensors.queue", f"{fullest:g} packets exceed the capacity of {scenario.queue_capacity}")
        if (latest := np.maximum.reduce(sensors.beacon, initial=0)) > step:
            raise Refused(f"{at}sensors.last_seen", f"step {latest} is later than this step {step}")
        if report.outcome is not None:
            self._pending.check_outcome(report.outcome, report.uav_id, f"{at}outcome.")
        return report

    def remember(self, uav: UavState, step: int, decision_id: str) -> None:
        """Make an answered report the UAV's reference; without an uplink in the report the UAV has none."""
        if uav.uplink is None:
            self._references.pop(uav.uav_id, None)
            return
        self._references[uav.uav_id] = ReferenceReport(decision_id, step, _array(uav.sensors))

    def _in_full(self, uav: AnyReport, step: int, at: str) -> AnyReport:
        """A report that leaves out positions, or sensors that its reference has, in full."""
        positions = self._belief.places
        changed = uav.sensors
        if uav.base is None:
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
        queue, battery, gain, seen = ([None if v != v else v for v in column.tolist()] for column in columns[1:])
        # Validation is skipped: each number passed it when its report arrived.
        places: dict[str, Any] = {"id": ids.tolist(), "x": x.tolist(), "y": y.tolist()}
        heard: dict[str, Any] = {"queue": queue, "battery": battery, "channel_gain": gain}
        steps = [None if step is None else int(step) for step in seen]
        whole = SensorColumns.model_construct(**places, **heard, last_seen=steps)
        return uav.model_copy(update={"base": None, "uplink": "delta", "sensors": whole})

    def _check_step(self, step: int) -> None:
        """Refuse a report from the future: it would count as the newest, and later true reports would be too old.

        A fleet may be out of contact for as long as its scenario lasts. The first report may be of any step: an edge
        that lost its missions meets them in mid-flight, and fleets fly on past their scenario's last step.
        """
        ahead, newest = max(MAX_STEPS_APART, self._scenario.steps), self._belief.newest
        if step == 0 and newest is not None and newest > _STEPS_BACK:
            log.warning("mission %s: step 0 after step %d: to fly it again, DELETE it first", self._mission_id, newest)
        if newest is not None and step > newest + ahead:
            raise Refused(
                "step",
                f"step {step} is more than {ahead} past {newest}, the newest step known of mission {self._mission_id}: "
                "DELETE the mission if its fleet was out of contact for so long",
            )

    def _check_metres(self, report: UavState, at: str) -> None:
        """Refuse longitudes and latitudes, of which the edge would only see that every sensor is near.

        Either all places are within 2 m of each other, or a UAV's first position has parts of a millimetre and is off
        its trajectory.
        """
        x, y = report.position
        if abs(x) > 180 or abs(y) > 90:
            return
        places = [(x, y), *zip(report.sensors.x or (), report.sensors.y or (), strict=True)]
        lowest, highest = np.min(places, axis=0), np.max(places, axis=0)
        if len(set(places)) < 3 or (highest - lowest).max() >= _DEGREES_APART:
            path = trajectories(self._scenario)[report.uav_id]
            exact = round(x, 3) != x and round(y, 3) != y
            if (
                report.uav_id in self._belief.uavs
                or not exact
                or progress_of(path, (x, y), report.progress_m) is not None
            ):
                return
        raise Refused(
            f"{at}position",
            f"{x:g}, {y:g} looks like degrees: the mission's world is in metres from "
            "its corner, x to the east and y to the north. Metres that are meant are sent in whole millimetres",
        )

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
    # numpy converts None to NaN.
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
