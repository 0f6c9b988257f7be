"""The paper's long prompt, of mode ``llm``: a table of the sensors, answered by a sensor and a velocity."""

from __future__ import annotations

from collections.abc import Sequence

from service.prompting.demonstrations import Solved
from service.prompting.prompt import Prompt, note_block
from service.prompting.rows import (
    EXPERIENCE_NOTE,
    UNKNOWN,
    Cells,
    cells,
    columns,
    experience,
    introduction,
    meanings,
    row,
)
from service.prompting.unpruned_state import UnprunedState
from shared.features.augmented_state import State
from shared.wire.schemas import Features
from shared.world.actions import Action
from shared.world.scenario import Scenario

_STATIC = """You direct a fleet of UAVs that collect data packets from ground sensors along a pipeline. \
At each waypoint you choose one sensor to collect from and the velocity for the next {step_s:g} seconds.

Goal: lose no packets. A sensor's queue holds {capacity} packets; what arrives beyond that is lost. \
A transmission fails beyond {radius:g} m, or at a channel gain of {limit:g} dB or below.

{introduction}
{meanings}

Rules:
1. Prefer a full queue, then a long age.
2. The sensor must be in reach after the UAV has moved.
3. Velocity, in whole m/s, follows the chosen sensor's distance: {far} beyond 50 m, {near} within 50 m, \
0 at the sensor.

{note}{experiences}{demonstrations}Answer with two whole numbers and nothing else: sensor_id velocity"""

# The paper's highest velocity within 50 m of the chosen sensor, m/s.
_NEAR_VELOCITY = 7
_EXAMPLES = "Worked examples, each solved by a scheduler that looks ahead:"


class Template:
    """The template of one mission's prompts.

    Args:
        scenario: the mission's world.
        features: the preset, which determines a row's columns.
        experiences: the most experiences of a prompt; with 0 the static block does not mention them.
        ranked: whether the rows are ordered best first.
        demonstrations: worked examples for the static block.
        note: the operator's note.
    """

    def __init__(
        self,
        scenario: Scenario,
        features: Features = "paper",
        *,
        experiences: int = 8,
        ranked: bool = True,
        demonstrations: Sequence[Solved] = (),
        note: str | None = None,
    ) -> None:
        self._columns = columns(features)
        self.demonstrations = "".join(map(self._demonstration, demonstrations))
        examples = f"{_EXAMPLES}\n\n{self.demonstrations}" if demonstrations else ""
        order = "the most promising first" if ranked else "in no particular order"
        self.static = _STATIC.format(
            step_s=scenario.step_s,
            capacity=scenario.queue_capacity,
            radius=scenario.radio_radius_m,
            limit=-scenario.path_loss_limit_db,
            far=_levels(_NEAR_VELOCITY + 1, scenario.max_velocity),
            near=_levels(1, min(_NEAR_VELOCITY, scenario.max_velocity)),
            introduction=introduction(self._columns, order),
            meanings=meanings(features),
            note=note_block(note),
            experiences=f"{EXPERIENCE_NOTE}\n\n" if experiences else "",
            demonstrations=examples,
        )

    def experience(self, seen: Cells, action: Action, cost: float, failed: bool) -> str:
        """A line of the experiences: the chosen sensor's row, the decision and its cost, which includes a failure."""
        return experience(seen, f"{action.sensor_id} {action.velocity}", f"{cost:.1f}")

    def unreported_row(self, sensor_id: int) -> Cells:
        """The row of a sensor that the report lacks."""
        return {**dict.fromkeys(self._columns, UNKNOWN), "sensor_id": str(sensor_id)}

    def prompt(
        self, state: State, kept_rows: Sequence[int], experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> Prompt:
        """The prompt for one decision.

        Args:
            kept_rows: the rows of the state to show, in this order.
            experiences: the lines of the block of experiences.
            nearest: lines of experiences for this prompt only.
        """
        last = "".join(nearest)
        return Prompt(
            static=self.static,
            experiences="".join(experiences),
            state=last + "".join(map(row, cells(state, kept_rows))),
            uncompressed=UnprunedState(state, row, last),
        )

    def _demonstration(self, solved: Solved) -> str:
        return f"{''.join(map(row, solved.rows))}Answer: {solved.sensor_id} {solved.velocity}\n\n"


def _levels(slowest: int, fastest: int) -> str:
    return f"{slowest} to {fastest}" if slowest < fastest else f"{fastest}"
