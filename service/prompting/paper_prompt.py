"""The paper's prompt, of mode ``llm``, in our own words; docs/results/paper.md sets its elements beside the paper's.

What never changes comes first, for the LLM server's prefix cache: so the cost function stands before the experiences.
"""

import tomllib
from collections.abc import Sequence
from importlib.resources import files
from sys import intern

from service.prompting.prompt import Prompt, note_block
from service.prompting.rows import EXPERIENCE_NOTE, UNKNOWN, Cells, cells, columns, experience, introduction, row
from service.prompting.unpruned_state import UnprunedState
from shared.features.augmented_state import State
from shared.wire.schemas import Features
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

# The static blocks, before the mission's numbers are in them.
STATIC_BLOCKS = tomllib.loads(files("service.prompting").joinpath("static_blocks.toml").read_text(encoding="utf-8"))

# The paper's highest velocity within 50 m of the chosen sensor, m/s.
_NEAR_VELOCITY = 7


class Template:
    """The template of one mission's prompts.

    Args:
        scenario: the mission's world.
        features: the preset, which determines a row's columns.
        experiences: the most experiences of a prompt; with 0 the static block does not mention them.
        ranked: whether the rows are ordered best first.
        note: the operator's note.
    """

    def __init__(
        self,
        scenario: Scenario,
        features: Features = "paper",
        *,
        experiences: int = 30,
        ranked: bool = True,
        note: str | None = None,
    ) -> None:
        self._columns = columns(features)
        order = "the most promising first" if ranked else "in no particular order"
        static = STATIC_BLOCKS["paper"].format(
            last=scenario.sensors - 1,
            max_velocity=scenario.max_velocity,
            step_s=scenario.step_s,
            capacity=scenario.queue_capacity,
            radius=scenario.radio_radius_m,
            limit=-scenario.path_loss_limit_db,
            far=_levels(_NEAR_VELOCITY + 1, scenario.max_velocity),
            near=_levels(1, min(_NEAR_VELOCITY, scenario.max_velocity)),
            kept="sensors that attention selected" if ranked else "sensors",
            order=order,
            introduction=introduction(features),
            note=note_block(note),
            experiences=f"{EXPERIENCE_NOTE}\n\n" if experiences else "",
        )
        # Missions of one scenario share the text.
        self.static = intern(static)

    def experience(self, seen: Cells, action: Action, cost: float, failed: bool) -> str:
        """A line of the experiences: the chosen sensor's row, the decision and its cost, which includes a failure."""
        return experience(seen, f"{action.sensor_id} {action.velocity}", f"{cost:.2f}")

    def unreported_row(self, sensor_id: int) -> Cells:
        """The row of a sensor that the report lacks."""
        return {**dict.fromkeys(self._columns, UNKNOWN), "sensor_id": str(sensor_id)}

    def prompt(self, state: State, kept_rows: Sequence[int], experiences: Sequence[str]) -> Prompt:
        """The prompt for one decision.

        Args:
            kept_rows: the rows of the state to show, in this order.
            experiences: the lines of the block of experiences.
        """
        east, north = state.position
        last = f"UAV at {east:.0f},{north:.0f}\n"
        return Prompt(
            static=self.static,
            experiences="".join(experiences),
            state=last + "".join(map(row, cells(state, kept_rows))),
            uncompressed=UnprunedState(state, last),
            kept=kept_rows,
        )


def _levels(slowest: int, fastest: int) -> str:
    return f"{slowest} to {fastest}" if slowest < fastest else f"{fastest}"
