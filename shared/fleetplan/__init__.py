"""The fleet's planner: the actions of all UAVs over a horizon that lose the fewest packets.

It needs the extra ``service`` or ``planner``.
"""

from __future__ import annotations

from shared.fleetplan.belief import FleetBelief
from shared.fleetplan.greedy import look_ahead
from shared.fleetplan.problem import Course, FleetProblem, Found, fly
from shared.fleetplan.receding import Draft, RecedingHorizon
from shared.fleetplan.solver import Budget, Interrupted, News, Plan, least_loss, plan

__all__ = [
    "Budget",
    "Course",
    "Draft",
    "FleetBelief",
    "FleetProblem",
    "Found",
    "Interrupted",
    "News",
    "Plan",
    "RecedingHorizon",
    "fly",
    "least_loss",
    "look_ahead",
    "plan",
]
