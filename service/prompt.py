"""The prompt, in three blocks ordered for prefix caching: static, experiences, current task.

The static block is byte-identical for a mission's life and the experiences only grow between compactions, so an
LLM server with a prefix cache reads only the last block anew. Nothing volatile stands before it. The columns' names
are part of the static block: they never change, and there they cost nothing after the first decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.features import State
from shared.scenario import Scenario

_STATIC = """You direct a fleet of UAVs that collect data packets from ground sensors along a pipeline. \
At each waypoint you choose one sensor to collect from and the velocity for the next {step_s:g} seconds.

Goal: lose no packets. A sensor's queue holds {capacity} packets; what arrives beyond that is lost. \
A transmission fails beyond {radius:g} m, at a channel gain of {limit:g} dB or below, or on an empty battery.

Each row is one sensor, the most promising first, with six numbers:
sensor_id,queue,battery,gain,age,distance
queue: percent full. battery: percent left. gain: channel gain in dB. \
age: steps since its last visit. distance: metres from this UAV.

Rules:
1. Prefer a full queue, then a long age.
2. The sensor must be in reach after the UAV has moved.
3. Velocity is a whole number from 0 to {max_velocity} m/s. Fly slowly to stay near a far sensor with a full queue, \
fast when the sensor is near or there is little to collect.

Past decisions are rows followed by > sensor_id velocity and the cost that came of it; 0 is best.

Answer with two whole numbers and nothing else: sensor_id velocity"""


@dataclass(frozen=True, slots=True)
class Prompt:
    """One prompt. ``state_uncompressed`` is the last block as it would be with every reported sensor."""

    static: str
    experiences: str
    state: str
    state_uncompressed: str

    @property
    def user(self) -> str:
        """The user message: experiences, then the current task."""
        return f"{self.experiences}{self.state}"


def static_block(scenario: Scenario) -> str:
    """Task, rules, velocity strategy and output format; the same bytes for the same scenario."""
    return _STATIC.format(
        step_s=scenario.step_s,
        capacity=scenario.queue_capacity,
        radius=scenario.radio_radius_m,
        limit=-scenario.path_loss_limit_db,
        max_velocity=scenario.max_velocity,
    )


def row_text(state: State, row: int, scenario: Scenario) -> str:
    """One sensor as ``sensor_id,queue,battery,gain,age,distance``; question marks for what was never heard."""
    distance = round(float(state.distance[row]))
    age = round(float(state.since_visit[row]))
    if not state.heard[row]:
        return f"{state.ids[row]},?,?,?,{age},{distance}"
    queue = round(100 * float(state.queue[row]) / scenario.queue_capacity)
    battery = round(100 * float(state.battery[row]) / scenario.battery_j)
    return f"{state.ids[row]},{queue},{battery},{round(float(state.gain[row]))},{age},{distance}"


def experience_text(row: str, sensor_id: int, velocity: int, cost: float) -> str:
    """One line of the experiences: the chosen sensor's row, the decision, and its cost."""
    return f"{row} > {sensor_id} {velocity} cost {cost:.2f}\n"


def build_prompt(scenario: Scenario, state: State, kept_rows: Sequence[int], experiences: Sequence[str]) -> Prompt:
    """The prompt for one decision; ``kept_rows`` index the state's rows, best first."""
    return Prompt(
        static=static_block(scenario),
        experiences="".join(experiences),
        state=_rows(state, kept_rows, scenario),
        state_uncompressed=_rows(state, np.arange(len(state.ids)).tolist(), scenario),
    )


def _rows(state: State, rows: Sequence[int], scenario: Scenario) -> str:
    return "".join(f"{row_text(state, row, scenario)}\n" for row in rows)
