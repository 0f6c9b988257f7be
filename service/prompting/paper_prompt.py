"""The paper's prompt, of mode ``llm``, in our own words; docs/results/paper.md sets its elements beside the paper's.

What never changes comes first, for the LLM server's prefix cache: so the cost function stands before the experiences.
"""

from collections.abc import Sequence
from sys import intern

from service.prompting.prompt import Prompt, note_block
from service.prompting.rows import EXPERIENCE_NOTE, UNKNOWN, Cells, cells, columns, experience, introduction, row
from service.prompting.unpruned_state import UnprunedState
from shared.features.augmented_state import State
from shared.wire.schemas import Features
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

_STATIC = """You schedule data collection for a fleet of UAVs that fly over ground sensors along a pipeline.

Goal: lose as few packets as possible over all sensors. At each waypoint make two decisions: the one ground sensor to \
collect from (ID 0 to {last}), and the velocity for the next {step_s:g} seconds (0 to {max_velocity} m/s).

Procedure:
1. Look at every sensor of the current task: its queue, residual energy, location, channel quality (path loss), time \
since its last visit, urgency and overflow probability.
2. Rank the sensors. What speaks for one is a long queue, a high urgency or overflow probability, a long time without \
a visit, little residual energy and a good channel (low path loss).
3. Compare with past decisions and what they led to.
4. Choose exactly one sensor and one velocity.

Scheduling rules:
- Long queues come first, so that they do not overflow.
- A better channel (a higher gain, less path loss) makes a transmission more likely to succeed. It fails beyond \
{radius:g} m, or at a gain of {limit:g} dB or below.
- Collect from a sensor with a low battery before its energy is used up.
- A high UrgencyScore comes first, above all with a high OverflowProb: such a sensor is the next to drop packets.
- A large TimeSinceLastVisit comes first, so that every sensor gets its share and none is neglected.

Velocity strategy, in whole m/s:
- By the chosen sensor's distance: {far} beyond 50 m, {near} within 50 m, 0 while hovering at it.
- A higher velocity can shorten the travel time.

Cost:
- Packet loss: a poor channel (high path loss) loses packets, so a sensor with a better channel costs less.
- Queue overflow: a queue holds {capacity} packets; what arrives beyond that is dropped, which raises the cost.

The current task is the UAV's waypoint and a row for each of the {kept}, {order}:
{introduction}

{note}{experiences}Output: exactly two whole numbers with a space between them, sensor_id velocity, \
and nothing else: no explanation, no reasoning."""

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
        static = _STATIC.format(
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
        return experience(seen, f"{action.sensor_id} {action.velocity}", f"{cost:.1f}")

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
            uncompressed=UnprunedState(state, row, last),
            kept=kept_rows,
        )


def _levels(slowest: int, fastest: int) -> str:
    return f"{slowest} to {fastest}" if slowest < fastest else f"{fastest}"
