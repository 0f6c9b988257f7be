"""The fleet's planner: what all UAVs do over a horizon so that the fewest packets are lost (extra ``planner``)."""

from __future__ import annotations

from shared.fleetplan.belief import FleetBelief
from shared.fleetplan.greedy import look_ahead
from shared.fleetplan.problem import Course, FleetProblem, fly, price
from shared.fleetplan.receding import Draft, RecedingHorizon
from shared.fleetplan.risk import neglect
from shared.fleetplan.solver import Budget, Interrupted, News, Plan, least_loss, plan

__all__ = [
    "Budget",
    "Course",
    "Draft",
    "FleetBelief",
    "FleetProblem",
    "Interrupted",
    "News",
    "Plan",
    "RecedingHorizon",
    "fly",
    "least_loss",
    "look_ahead",
    "neglect",
    "plan",
    "price",
]
