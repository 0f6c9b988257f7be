"""The compact prompt: one digit for each number, for an LLM with the adapter that was trained on it.

The user message is one line of letters and digits, which the embedded model reads as one token each:

    7 d 9 X   4 a 0 Y   9 3 4 2 1 5 U   7 d 3 5 9 2 8 4 6 A   9 a 1 6 9 3 0 4 4 E   ...      (without the spaces)

First the experiences, which end with ``X`` or ``Y``: see :meth:`CompactTemplate.experience`. ``U`` ends the UAV's own
six digits, and a row's first choice letter its sensor's eight: a causal model has read a row where it reads the row's
letter. :func:`fleet_digits` and :func:`row_digits` define the digits. The second place of an experience and of a row is
its sensor's sign, by which the model finds the sensor's earlier outcomes. An adapter names the version of this prompt
that it was trained on: :data:`service.llm.adapter_version.PROMPT_VERSION` changes whenever a text here does.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.prompting.candidates import CandidateSet, Viewpoint
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.rows import UNKNOWN, Cells
from shared.belief.learned_channel import LIKELY, ExpectedLinks
from shared.features.augmented_state import Reach, State
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

STATIC = "Collect packets. Answer with one letter."
# A sensor's sign: the one at its ID, modulo their number. Between digits each is one token of the embedded model.
SIGNS = "abcdefghijklmnopqrstuvwxyzαβγδεζηθικλμνοπρςστυφχωбвгдежзийклмнопрстуфхцчшщыьюяàáâãäåæçèéêëìíîïñòóôõöùúûüý"

# The outlook's steps, and the pace of every UAV in them as a share of full speed.
_STEPS = 9
_PACE = 0.6
# The steps of the outlook whose urgency the prompt shows, from 0.
_SHOWN_STEPS = [0, 1, 3, 7]
# The sum of urgencies that the digit 9 stands for.
_MOST_URGENCY = 3.0
_NINE = 9
_ROW = re.compile(r"(\d)(\D)(\d{7})(\D)")


@dataclass(frozen=True, slots=True)
class Outlook:
    """The fleet's reach in its next steps at a steady pace, for J sensors.

    Attributes:
        own: shape ``(J,)``, the steps of the next nine in which the UAV is likely to reach each sensor.
        others: shape ``(J,)``, the same of the other UAVs, added up.
        ahead: shape ``(9, J)``, whether the UAV reaches each sensor in each of these steps.
    """

    own: NDArray[np.int64]
    others: NDArray[np.int64]
    ahead: NDArray[np.bool_]

    @classmethod
    def of(cls, view: Viewpoint, scenario: Scenario) -> Self:
        """From the fleet's belief."""
        metres = _PACE * scenario.max_velocity * scenario.step_s * np.arange(1.0, _STEPS + 1.0)
        reached = {uav: _reached(view, uav, metres, scenario) for uav in {view.uav_id, *view.belief.present(view.step)}}
        own = reached.pop(view.uav_id)
        others = np.sum([steps.sum(axis=0) for steps in reached.values()], axis=0, dtype=np.int64)
        return cls(own.sum(axis=0), np.broadcast_to(others, own.shape[1:]), own)


def _reached(view: Viewpoint, uav: int, metres: FloatArray, scenario: Scenario) -> NDArray[np.bool_]:
    belief = view.belief
    if view.learned:
        links = belief.links(uav, metres)
    else:
        links = ExpectedLinks.by_formula(belief.distances(uav, metres), scenario)
    return np.asarray((links.packets > 0) & (links.hold >= LIKELY))


def sign(sensor_id: int) -> str:
    """A sensor's sign in the prompt."""
    return SIGNS[sensor_id % len(SIGNS)]


def digits(values: ArrayLike) -> NDArray[np.int64]:
    """Numbers as digits: rounded, at least 0 and at most 9."""
    return np.clip(np.rint(np.asarray(values, dtype=np.float64)), 0, _NINE).astype(np.int64)


def fleet_digits(state: State, outlook: Outlook, step: int, scenario: Scenario) -> str:
    """The UAV's six digits.

    They are the steps left, at most 9; the mean fill of the sensors' queues, 9 for W; and the urgency of the sensors
    that the UAV reaches after 1, 2, 4 and 8 steps, 9 for a sum of 3.
    """
    fill = state.queue.mean() / scenario.queue_capacity
    urgency = outlook.ahead[_SHOWN_STEPS][:, state.ids] @ state.urgency
    shown = digits([scenario.steps - step, _NINE * fill, *(_NINE / _MOST_URGENCY * urgency)])
    return "".join(map(str, shown.tolist()))


def row_digits(state: State, reach: Reach, outlook: Outlook, scenario: Scenario) -> NDArray[np.int64]:
    """Each sensor's six digits, ``(J, 6)``.

    They are the queue, ``9 sqrt(q / W)``; the steps until it overflows; the packets that the UAV can collect at the
    velocity of most worth, ``9 sqrt(m / W)``; the probability that the link holds there, 9 for certain; the steps of
    the next nine in which this UAV reaches the sensor; and the same of the other UAVs, added up.
    """
    capacity, rows = scenario.queue_capacity, np.arange(len(state.ids))
    room = capacity - state.queue
    left = np.divide(room, state.rate, out=np.full_like(room, _NINE), where=state.rate > 0)
    columns = (
        _NINE * np.sqrt(state.queue / capacity),
        np.floor(left),
        _NINE * np.sqrt(reach.best_packets / capacity),
        _NINE * reach.links.hold[reach.best, rows],
        outlook.own[state.ids],
        outlook.others[state.ids],
    )
    return np.stack([digits(column) for column in columns], axis=1)


def in_words(text: str, shown: Collection[int], scenario: Scenario) -> list[str]:
    """What a prompt's digits say: a sentence on the UAV, then on each row of these sensors, in the prompt's order."""
    capacity, ids = scenario.queue_capacity, {sign(sensor): sensor for sensor in shown}
    most, steps, fill = {_NINE: "9 or more"}, int(text[0]), int(text[1]) / _NINE
    words = [f"{most.get(steps, steps)} steps are left. The mean queue is {fill:.0%} full."]
    for queue, own, numbers, letter in _ROW.findall(text[7:]):
        left, packets, hold, reach, others, slow, fast = map(int, numbers)
        held, moved = (round(capacity * (int(digit) / _NINE) ** 2) for digit in (queue, packets))
        slowest, fastest = (round(scenario.max_velocity * digit / _NINE) for digit in (slow, fast))
        words.append(
            f"{letter}: sensor {ids.get(own, own)} has about {held} of {capacity} packets and overflows in "
            f"{most.get(left, left)} steps. The UAV collects up to about {moved} at {slowest} to {fastest} m/s; the "
            f"link holds with {hold / _NINE:.0%}. The UAV reaches it in {reach} of the next 9 steps, others in "
            f"{most.get(others, others)}."
        )
    return words


class CompactTemplate(GuidedTemplate):
    """The template of the compact prompt; its rows are shuffled, and its letters carry no rank.

    It has no note. The caller gives :meth:`candidates` a state in which the note's orders are queues:
    :mod:`service.deciding.attended_state`.
    """

    # The adapter is trained on soft targets: 0.23 is the mean of its highest probability among some 20 candidates.
    sharpness = 4.0

    def __init__(self, scenario: Scenario, *, rows: int) -> None:
        super().__init__(scenario, rows=rows, experiences=0, ranked=False)
        self._scenario = scenario
        self.static = STATIC

    def experience(self, seen: Cells, action: Action, cost: float, failed: bool) -> str:
        """An experience such as ``7d9X``.

        It has the packets that the edge expected the sensor to send, ``9 sqrt(m / W)``; the sensor's sign; the cost,
        9 for at least 1; and ``X`` for a failed transmission, else ``Y``.
        """
        expected = seen.get("movable", seen["queue"])
        packets = 0 if expected == UNKNOWN else int(expected)
        shown = digits([_NINE * np.sqrt(max(packets, 0) / self._scenario.queue_capacity), _NINE * cost])
        return f"{shown[0]}{sign(action.sensor_id)}{shown[1]}{'X' if failed else 'Y'}"

    def candidates(
        self, state: State, seen: Reach, offered: Reach, shown: Sequence[int], view: Viewpoint
    ) -> CandidateSet:
        """The candidates for these rows of a state, with the whole user message as their text."""
        scenario = self._scenario
        outlook = Outlook.of(view, scenario)
        numbers = row_digits(state, seen, outlook, scenario)
        level = _NINE / scenario.max_velocity

        def write(rows: Sequence[int], letters: str, options: Sequence[Sequence[int]]) -> str:
            spans = digits([(level * own[0], level * own[-1]) for own in options])
            shown_digits = np.concatenate((numbers[list(rows)], spans.reshape(-1, 2)), axis=1).tolist()
            signs = map(sign, state.ids[list(rows)].tolist())
            text = f"{fleet_digits(state, outlook, view.step, scenario)}U"
            return text + "".join(
                f"{row[0]}{own}{''.join(map(str, row[1:]))}{letter}"
                for letter, own, row in zip(letters, signs, shown_digits, strict=True)
            )

        return CandidateSet.of(state, offered, shown, self.letters, view, write)

    def content_free(self, uavs: Sequence[int] = ()) -> list[str]:
        """None: the adapter is trained with shuffled rows, so it has no bias towards letters to be measured."""
        return []
