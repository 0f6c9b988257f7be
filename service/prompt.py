"""The prompt, in three blocks ordered for prefix caching: static, experiences, current task.

The static block is byte-identical for a mission's life and the experiences only grow between compactions, so an
LLM server with a prefix cache reads only the last block anew. Nothing volatile stands before it. The columns' names
are part of the static block: they never change, and there they cost nothing after the first decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from service.features import State
from shared.scenario import Scenario

_STATIC = """You direct a fleet of UAVs that collect data packets from ground sensors along a pipeline. \
At each waypoint you choose one sensor to collect from and the velocity for the next {step_s:g} seconds.

Goal: lose no packets. A sensor's queue holds {capacity} packets; what arrives beyond that is lost. \
A transmission fails beyond {radius:g} m, or at a channel gain of {limit:g} dB or below.

Each row is one sensor, the most promising first, with five numbers:
sensor_id,queue,gain,age,distance
queue: packets waiting. gain: channel gain in dB. age: steps since its last visit. distance: metres from this UAV.

Rules:
1. Prefer a full queue, then a long age.
2. The sensor must be in reach after the UAV has moved.
3. Velocity is a whole number from 0 to {max_velocity} m/s. Fly slowly to stay near a far sensor with a full queue, \
fast when the sensor is near or there is little to collect.

Past decisions are rows without their first number, then > sensor_id velocity: cost, where 0 is best.

Answer with two whole numbers and nothing else: sensor_id velocity"""


@dataclass(frozen=True, slots=True)
class Prompt:
    """One prompt. ``state_uncompressed`` is the last block as it would be without attention and masks."""

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


def row_text(state: State, row: int) -> str:
    """One sensor of those kept: ``sensor_id,queue,gain,age,distance``.

    No battery: a sensor that cannot send is masked before, so that the LLM need not judge it.
    """
    return f"{state.ids[row]},{_judged(state, row)}"


def full_row_text(state: State, row: int) -> str:
    """One sensor as an LLM would have to see it if nothing were pruned or masked for it.

    ``sensor_id,queue,battery,gain,age,distance``, with question marks for what was never heard.
    """
    if not state.heard[row]:
        return f"{state.ids[row]},?,?,?,{state.since_visit[row]:.0f},{state.distance[row]:.0f}"
    queue, rest = _judged(state, row).split(",", 1)
    return f"{state.ids[row]},{queue},{state.battery[row]:.0f},{rest}"


def _judged(state: State, row: int) -> str:
    numbers = (state.queue[row], state.gain[row], state.since_visit[row], state.distance[row])
    return ",".join(f"{number:.0f}" for number in numbers)


def experience_text(row: str, sensor_id: int, velocity: int, cost: float) -> str:
    """One line of the experiences: the chosen sensor's row, the decision, and its cost."""
    return f"{row.split(',', 1)[1]} > {sensor_id} {velocity}: {cost:.1f}\n"


def build_prompt(scenario: Scenario, state: State, kept_rows: Sequence[int], experiences: Sequence[str]) -> Prompt:
    """The prompt for one decision; ``kept_rows`` index the state's rows, best first."""
    return Prompt(
        static=static_block(scenario),
        experiences="".join(experiences),
        state="".join(f"{row_text(state, row)}\n" for row in kept_rows),
        state_uncompressed="".join(f"{full_row_text(state, row)}\n" for row in range(len(state.ids))),
    )
