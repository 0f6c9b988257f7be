"""Checks of a UAV's report against its mission, before the report changes anything."""

from __future__ import annotations

from service.errors import Refused
from service.mission.delta_reports import AnyReport
from service.mission.mission import Mission
from service.mission.reservations import MAX_STEPS_APART


def complete_report(mission: Mission, report: AnyReport, step: int, at: str = "") -> AnyReport:
    """The report with everything that it leaves out, once it fits the mission's world.

    Args:
        at: the path of the UAV in the request's body, such as ``uavs[1].``.

    Raises:
        Refused: a step far past the newest one, an unknown UAV or sensor, a queue past its capacity, a beacon later
            than the step, an outcome of another UAV's decision, or as :meth:`DeltaReports.complete`.
        Incomplete: as :meth:`DeltaReports.complete`.
        NotFound: an outcome of a decision that the mission does not know.
    """
    scenario = mission.scenario
    _check_step(mission, step)
    if report.uav_id >= scenario.uavs:
        raise Refused(f"{at}uav_id", f"UAV {report.uav_id} is unknown: this mission has {scenario.uavs}, from 0")
    if (highest := max(report.sensors.id, default=0)) >= scenario.sensors:
        raise Refused(f"{at}sensors.id", f"sensor {highest} is unknown: there are {scenario.sensors}, from 0")
    report = mission.delta_reports.complete(report, step, mission.belief.places, at)
    fullest = max((q for q in report.sensors.queue if q is not None), default=0.0)
    if fullest > scenario.queue_capacity:
        raise Refused(f"{at}sensors.queue", f"{fullest:g} packets exceed the capacity of {scenario.queue_capacity}")
    if (latest := max((s for s in report.sensors.last_seen if s is not None), default=0)) > step:
        raise Refused(f"{at}sensors.last_seen", f"step {latest} is later than this step {step}")
    if report.outcome is not None:
        mission.pending.check_outcome(report.outcome, report.uav_id, f"{at}outcome.")
    return report


def _check_step(mission: Mission, step: int) -> None:
    """Refuse a report from the future: it would count as the newest, and later true reports would be too old.

    A fleet may be out of contact for as long as its scenario lasts. The first report may be of any step: an edge that
    lost its missions meets them in mid-flight, and fleets fly on past their scenario's last step.
    """
    newest, ahead = mission.belief.newest, max(MAX_STEPS_APART, mission.scenario.steps)
    if newest is not None and step > newest + ahead:
        raise Refused(
            "step",
            f"step {step} is more than {ahead} past {newest}, the newest step known of mission {mission.mission_id}: "
            "DELETE the mission if its fleet was out of contact for so long",
        )
