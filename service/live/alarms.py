"""What may need the operator now: UAVs lost or off their paths, late visits, low batteries; for pages and alerts."""

from collections.abc import Mapping, Sequence

import numpy as np

from service.mission.mission import Mission
from shared.wire.missions import VisitDeadline

KINDS = ("uav_lost", "uav_off_path", "uav_battery", "visit_late", "sensor_battery")
# Steps without a report after which a UAV counts as lost: a decision or two may be late or made on board.
_LOST_STEPS = 3
# A share of a full battery; percent of a UAV's, from which it still comes home before its autopilot's failsafe.
_BATTERY, _UAV_BATTERY = 0.15, 25.0


def alarms(
    mission: Mission, orders: Sequence[VisitDeadline], batteries: Mapping[int, float]
) -> dict[str, dict[int, int | None]]:
    """By kind of :data:`KINDS`, the UAVs or sensors with the step since when, None if that is unknown.

    Args:
        orders: the mission's deadlines.
        batteries: by UAV, percent of its own battery, where that was reported.
    """
    belief, step = mission.belief, mission.belief.newest or 0
    # The belief flies a UAV's decision on, so that its own step may be past its newest report's.
    lost = {uav: last.taught for uav, last in belief.uavs.items() if step - last.taught > _LOST_STEPS}
    due = {
        order.sensor_id: max(int(mission.records.visits[order.sensor_id]), order.since - 1) + order.visit_every
        for order in orders
        if order.until is None
    }
    low = np.flatnonzero((belief.heard >= 0) & (belief.battery < _BATTERY * mission.scenario.battery_j))
    return {
        "uav_lost": dict[int, int | None](lost),
        "uav_off_path": {uav: None for uav, last in belief.uavs.items() if last.progress_m is None and uav not in lost},
        "uav_battery": {uav: None for uav, percent in batteries.items() if percent < _UAV_BATTERY},
        "visit_late": {sensor: at for sensor, at in due.items() if step > at},
        "sensor_battery": dict.fromkeys(low.tolist()),
    }
