"""The paper's own prompt, as far as it is known: every sensor in words, and the newest 30 experiences.

The figure with the template was not available. This template has its known parts (arXiv 2510.05698), in our own words:
the task, the rules, the velocity strategy and the form of the answer; past decisions with state, action and cost; all J
sensors, with battery, queue, channel and visiting record, in about as many tokens as the paper states. Two choices make
it shorter than the original may be: an experience names only the chosen sensor, and experiences have no numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

from service.prompting.experiences import Experiences
from service.prompting.paper_prompt import Template
from service.prompting.prompt import Prompt
from service.prompting.rows import UNKNOWN, Cells
from service.prompting.unpruned_state import UnprunedState
from shared.features.augmented_state import State
from shared.world.actions import Action
from shared.world.scenario import Scenario

EXPERIENCES = 30
# The paper's number of tokens for ten sensors without attention.
STATED_STATE_TOKENS = 213.7

_STATIC = """You are an assistant at the network edge that schedules data collection for unmanned aerial vehicles \
(UAVs). The UAVs fly along a pipeline and collect data packets from ground sensors.

Task: at each waypoint, select one ground sensor to collect data from and the velocity of the UAV for the next \
{step_s:g} seconds, so that the packet loss of the network is as small as possible. Packets are lost when the queue of \
a sensor, which holds {capacity} packets, overflows, and when a transmission fails because the channel is poor.

Input: for each ground sensor its battery level in J, its queue length in packets, its channel gain in dB, and its \
age, the steps since its last visit.

Rules:
1. Give priority to sensors whose queue is long, because their buffers are about to overflow.
2. Among these, prefer sensors with a good channel gain; beyond {radius:g} m or below {limit:g} dB transmissions fail.
3. Do not select sensors whose battery is empty.
4. Do not neglect sensors that have not been visited for a long time.

Velocity strategy: the velocity is a whole number between 0 and {max_velocity} m/s. Reduce the velocity near sensors \
with long queues and poor channels, and increase it when queues are short.

Feedback: past decisions are listed with the state of the sensor, the decision and the cost that it led to. Learn from \
them: prefer decisions like those with a low cost, and avoid those with a high cost.

Output: the ID of the selected sensor and the velocity, two whole numbers and nothing else: sensor_id velocity"""


class PaperTemplate(Template):
    """A prompt with a sentence for every reported sensor, without attention and masks."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario, experiences=EXPERIENCES)
        self.static = _STATIC.format(
            step_s=scenario.step_s,
            capacity=scenario.queue_capacity,
            radius=scenario.radio_radius_m,
            limit=-scenario.path_loss_limit_db,
            max_velocity=scenario.max_velocity,
        )

    def experience(self, seen: Cells, action: Action, cost: float, failed: bool) -> str:
        """The chosen sensor's state, the decision and its cost, in a sentence."""
        state = _sentence({name: text for name, text in seen.items() if name != "distance"})
        return f"{state}; decision: sensor {action.sensor_id}, velocity {action.velocity}; cost {cost:.1f}\n"

    def prompt(
        self, state: State, kept_rows: Sequence[int], experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> Prompt:
        """The prompt for one decision; ``kept_rows`` and ``nearest`` are ignored."""
        whole = UnprunedState(state, lambda cells: _sentence(cells) + "\n", "Current state:\n")
        past = "Past decisions:\n" + "".join(experiences) if experiences else ""
        return Prompt(self.static, past, whole.text, whole)


class Newest(Experiences):
    """The newest experiences up to the limit: a new one removes the oldest, which moves all the others."""

    def _chosen(self, keep: int) -> list[str]:
        return self.block[-self.limit :]


def _sentence(cells: Cells) -> str:
    words = {
        "battery": "battery {} J",
        "queue": "queue {}",
        "gain": "channel {} dB",
        "age": "age {}",
    }
    told_of = {name: "unknown" if cells[name] == UNKNOWN else cells[name] for name in words if name in cells}
    return f"Sensor {cells['sensor_id']}: " + ", ".join(words[name].format(text) for name, text in told_of.items())
