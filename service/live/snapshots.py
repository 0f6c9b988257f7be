"""A mission as the page draws it, as JSON: all of it, or what changes from one moment to the next."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic_core import to_json

from service.live.recent_decisions import RecentDecision
from service.mission.mission import Mission
from shared.scenario import Scenario
from shared.trajectory import trajectories
from shared.urgency import urgency

# Points of a trajectory: a circle of 300 m is then off by less than half a metre.
_POINTS = 97


def snapshot(mission: Mission, kept: list[RecentDecision], edge: str) -> bytes:
    """All that the page needs to begin, decisions included.

    Args:
        edge: this process's own name: another's knows nothing of the decisions before.
    """
    scenario = mission.scenario
    return _json(
        {
            "edge": edge,
            "mission": {
                "mission_id": mission.mission_id,
                "mode": mission.mode,
                "asks": mission.spec.uses_llm,
                "planner": mission.planner is not None,
                "top_k": mission.top_k,
                "note": mission.guidance.note,
            },
            "scenario": scenario.model_dump(include=_SHOWN),
            "pipeline": scenario.pipeline if scenario.layout != "uniform" else (),
            "trajectories": _curves(scenario),
            "places": np.round(mission.belief.places, 1).tolist(),
            "decisions": [one.told() for one in kept],
            "outcomes": [],
            **_moment(mission),
        }
    )


def update(mission: Mission, kept: list[RecentDecision], since: int) -> bytes:
    """What has changed.

    Args:
        since: of the history's order: decisions after it are told in full, of earlier ones the outcomes after it.
    """
    return _json(
        {
            "decisions": [one.told() for one in kept if one.order > since],
            "outcomes": [one.outcome for one in kept if one.order <= since < one.settled],
            **_moment(mission),
        }
    )


def named(mission: Mission) -> int:
    """How many sensors' places are known: the page must draw them once."""
    return int(np.isfinite(mission.belief.places[:, 0]).sum())


_SHOWN = {"name", "sensors", "uavs", "steps", "area_m", "step_s", "queue_capacity", "radio_radius_m", "max_velocity"}


def _moment(mission: Mission) -> dict[str, Any]:
    """What may differ every time: counts, and by sensor what the fleet believes now."""
    belief = mission.belief
    step = belief.newest or 0
    queue = belief.queue(step)
    return {
        "step": step,
        "made": mission.decisions,
        "settled": mission.feedback,
        "learner_updates": mission.learner.updates,
        "learner_loss": mission.learner.last_loss,
        "guidance": mission.guidance.status,
        "queue": np.round(queue, 1).tolist(),
        "urgency": np.round(urgency(queue, belief.rate, mission.scenario), 3).tolist(),
        "heard": belief.heard.tolist(),
        "visits": mission.records.visits.tolist(),
        "uavs": {uav: {"step": last.step, "position": last.position} for uav, last in belief.uavs.items()},
    }


def _curves(scenario: Scenario) -> list[Any]:
    return [np.round(t.at(np.linspace(0.0, t.length_m, _POINTS)), 1).tolist() for t in trajectories(scenario)]


def _json(value: dict[str, Any]) -> bytes:
    # A sensor that nobody has named has no place: NaN.
    return to_json(value, inf_nan_mode="null")
