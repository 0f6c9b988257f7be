"""The page's JSON of a mission: a snapshot, or the changes since the last update."""

import time
from typing import Any

import numpy as np
from pydantic_core import to_json

from service.live.alarms import alarms
from service.live.fleet_watch import Watched
from service.live.recent_decisions import RecentDecision
from service.mission.mission import Mission
from shared.planning.orders import once
from shared.world.trajectory import trajectories
from shared.world.urgency import urgency

# The most steps until a queue is full, for a sensor with hardly any arrivals.
_NEVER = 10_000
# Where along a trajectory its points are. The error for a circle of 300 m is less than half a metre.
_SHARES = np.linspace(0.0, 1.0, 97)


def snapshot(mission: Mission, decisions: list[RecentDecision], watched: Watched, edge: str) -> bytes:
    """The complete state of the page, with these decisions.

    Args:
        watched: the fleet's problems in its reports.
        edge: an ID of this process: after a restart the earlier decisions are unknown.
    """
    scenario = mission.scenario
    return _json(
        {
            "edge": edge,
            "mission": {
                **{name: getattr(mission, name) for name in ("mission_id", "mode", "top_k")},
                "asks": mission.spec.uses_llm,
                "planner": mission.planner is not None,
            },
            "scenario": scenario.model_dump(include=_SHOWN),
            "pipeline": scenario.pipeline if scenario.layout != "uniform" else (),
            "trajectories": [t.at(_SHARES * t.length_m).round(1).tolist() for t in trajectories(scenario)],
            "places": np.round(mission.places, 1).tolist(),
            "names": mission.spec.names,
            "map": mission.spec.map or (),
            "decisions": [decision.summary() for decision in decisions],
            "outcomes": [],
            "full_by_step": list(watched.full.items()),
            **_moment(mission, watched),
        }
    )


def update(mission: Mission, decisions: list[RecentDecision], watched: Watched, since: int) -> bytes:
    """The changes since an order of the history.

    Args:
        since: later decisions are complete; of earlier ones only the later outcomes are included.
    """
    return _json(
        {
            "decisions": [decision.summary() for decision in decisions if decision.order > since],
            "outcomes": [d.outcome for d in decisions if d.order <= since < d.outcome_order],
            "full_by_step": list(watched.full.items())[-_NEWEST_STEPS:],
            **_moment(mission, watched),
        }
    )


def drawn_places(mission: Mission) -> bytes:
    """The sensors' positions to 1 m, which the page draws once."""
    return mission.belief.places.round().tobytes()


_SHOWN = {"name", "sensors", "uavs", "steps", "area_m", "step_s", "queue_capacity", "radio_radius_m", "max_velocity"}
# The excess loss from which the page shows an alarm, dB: a tenth of the power arrives.
_WORSE_DB = 10.0
# Steps whose numbers an update repeats, so that none is missed.
_NEWEST_STEPS = 20


def _moment(mission: Mission, watched: Watched) -> dict[str, Any]:
    """The volatile part: counts, the fleet's belief of each sensor, and the operator's orders."""
    belief, scenario = mission.belief, mission.scenario
    step = belief.newest or 0
    queue, rate, orders = belief.queue(step), belief.arrivals.rate, mission.deadlines()
    measured = belief.channel.radio_map.measured_db()
    return {
        "step": step,
        "made": mission.decisions,
        "settled": mission.feedback,
        "learner_updates": mission.learner.updates,
        "learner_loss": mission.learner.last_loss,
        "guidance": _guidance(mission),
        "deadlines": {"met": sum(one.met for one in orders), "missed": sum(one.missed for one in orders)},
        "alarms": alarms(mission, orders, watched.batteries),
        **watched.totals(),
        "queue": np.round(queue, 1).tolist(),
        "urgency": np.round(urgency(queue, rate, scenario), 3).tolist(),
        "full_in": np.round((scenario.queue_capacity - queue) / np.maximum(rate, 1e-9), 1).clip(max=_NEVER).tolist(),
        "battery": np.round(belief.battery / scenario.battery_j, 3).tolist(),
        "heard": belief.heard.tolist(),
        "visits": mission.records.visits.tolist(),
        "failed_radios": belief.channel.failures.dead,
        "excess_db": {sensor: round(db, 1) for sensor, db in measured.items() if db >= _WORSE_DB},
        "step_took_s": watched.step_took_s,
        "uavs": {uav: _uav(mission, watched, uav) for uav in belief.uavs},
    }


def _uav(mission: Mission, watched: Watched, uav: int) -> dict[str, Any]:
    """A UAV's newest report, and where its decision brings it by the next waypoint."""
    belief, last = mission.belief, mission.belief.uavs[uav]
    at, battery, height_m = watched.uavs.get(uav, (None, None, None))
    goal = None
    if last.action is not None:
        goal = last.ahead(belief.trajectory(uav), belief.drift, [last.action[1] * mission.scenario.step_s])[0]
    return {
        "step": last.taught if last.taught >= 0 else last.step,
        "position_step": last.step,
        "position": last.position,
        "next": None if goal is None else np.round(goal, 1).tolist(),
        "battery": battery,
        "height_m": height_m,
        "heard_s": None if at is None else round(time.monotonic() - at, 1),
    }


def _guidance(mission: Mission) -> dict[str, Any]:
    """The operator's note, the guidance from it, the orders in force, and the visits that are due, with his names."""
    visits, confirmed = mission.records.visits.tolist(), mission.guidance.confirmed
    report = mission.report_guidance().model_dump(exclude={"mission_id"})
    orders = [order for order in report["orders"] if order["until"] is None]
    # As :mod:`service.live.alarms` counts: from the last visit, or from the order's first step.
    since = {order["name"]: max(order["since_step"] - 1, -1) for order in orders}
    return {
        **report,
        "orders": orders,
        "due": [
            {"sensor_id": one.sensor_id, "visit_every": one.visit_every, "due": last + one.visit_every}
            for one in confirmed.sensors
            if one.visit_every is not None
            and not once(name := f"visit:{one.sensor_id}", one.visit_every, confirmed.ends.get(name))
            for last in [max(visits[one.sensor_id], since.get(name, -1))]
        ],
    }


def _json(value: dict[str, Any]) -> bytes:
    # A sensor's position is NaN until a report names it.
    return to_json(value, inf_nan_mode="null")
