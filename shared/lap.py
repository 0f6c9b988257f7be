"""The scenario's laps as both sides know them: where a UAV will be after flying on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from shared.channel import FloatArray
from shared.scenario import Point, Scenario


def on_lap(scenario: Scenario, uav: int, position: Point, tolerance_m: float = 10.0) -> bool:
    """Whether a position, metres, lies on the circle that the scenario gives this UAV."""
    x, y = scenario.lap_centres[uav]
    return abs(math.dist(position, (x, y)) - scenario.lap_radius_m) <= tolerance_m


def positions_after(scenario: Scenario, uav: int, position: Point, distance_m: ArrayLike) -> FloatArray:
    """Positions on the lap, counter-clockwise from ``position``, after arc lengths ``(n,)``: ``(n, 2)``, metres."""
    x, y = scenario.lap_centres[uav]
    start = math.atan2(position[1] - y, position[0] - x)
    angle = start + np.asarray(distance_m, dtype=np.float64) / scenario.lap_radius_m
    return np.stack((x + scenario.lap_radius_m * np.cos(angle), y + scenario.lap_radius_m * np.sin(angle)), axis=-1)
