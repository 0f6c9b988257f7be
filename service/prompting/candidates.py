"""Mode ``guided``: the sensor-velocity pairs to choose from, and how an LLM names one with a single token.

A candidate's label is a letter. A row of the prompt shows a sensor's first letter; the letters after it stand for
its faster velocities. Always as many a row, so that the letters' places in the prompt, and with them what the LLM
favours a letter or a place by, are the same for a mission's life. Where several UAVs are asked about at once, each
has rows of its own whose letters begin with A, and the rows name the sensor, which two UAVs must not share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from string import ascii_uppercase
from typing import Self

import numpy as np

from service.prompting.prompt import Prompt, Template, note_block
from service.prompting.row_formats import FORMATS, Cells, cells
from service.prompting.unpruned_baseline import Uncompressed
from shared.actions import Action
from shared.channel import FloatArray
from shared.features import State
from shared.reach import Reach
from shared.scenario import Scenario

# OpenAI and vLLM tell the probabilities of at most 20 tokens.
_MOST_LABELS = 20
_MOST_PACES = 4
# Velocities at which at least this much of the most that can be moved is moved are all as good for the sensor.
_NEARLY = 0.9

_STATIC = """You direct a fleet of UAVs that collect data packets from ground sensors along a pipeline. \
At each waypoint you choose{each} one sensor to collect from and the velocity for the next {step_s:g} seconds.

Goal: lose no packets. A sensor's queue holds {capacity} packets; what arrives beyond that is lost.

{listed}Each row is one sensor, {order}: a letter, then
{number}queue,age,velocity
queue: packets waiting. age: steps since its last visit. velocity: the fastest, in m/s, at which the UAV can collect; \
the slowest before it where that is not 0.
{letters}

Rules:
1. Prefer a full queue, then a long age.
2. Fly slowly to stay near full queues, fast when there is little to collect.
{apart}
{note}{experiences}Answer with {answer} and nothing else."""

_ALONE = {"each": "", "listed": "", "number": "", "apart": "", "answer": "one letter"}
_TOGETHER = {
    "each": " for every UAV",
    "listed": "Each UAV has rows of its own, under its number. ",
    "number": "sensor,",
    "apart": "3. Never choose the same sensor for two UAVs.\n",
    "answer": "one letter for each UAV, in their order, each on a line of its own,",
}

_EXPERIENCES = "Past decisions are queue,age>velocity:cost, where 0 is the best cost.\n\n"
# Rows that say nothing of any sensor.
_CONTENT_FREE = ("N/A", "?,?,?")


def paces(labels_for: int) -> int:
    """Letters a row, where so many rows must do with 20: 4 at the most, at least 1."""
    return max(1, min(_MOST_PACES, _MOST_LABELS // labels_for))


class GuidedTemplate(Template):
    """The prompt of mode ``guided``; it has one format and no demonstrations.

    Args:
        scenario: the mission's world.
        rows: the most that a prompt shows.
        experiences: the most that it may hold; with 0 the static block does not speak of them.
        ranked: whether the rows come best first.
        note: the operator's.
    """

    def __init__(
        self, scenario: Scenario, *, rows: int, experiences: int, ranked: bool, note: str | None = None
    ) -> None:
        super().__init__(scenario, experiences=experiences, ranked=ranked)
        self.paces = paces(rows)
        self.rows = min(rows, _MOST_LABELS // self.paces)
        order = "the most promising first" if ranked else "in no particular order"
        named = ascii_uppercase[: self.paces]
        letters = (
            f"In the row that begins with {named[0]}, the letters {', '.join(named)} are its velocities, slowest to "
            "fastest; so in the other rows."
            if self.paces > 1
            else "The letter is the sensor at its fastest velocity."
        )
        said = {
            "step_s": scenario.step_s,
            "capacity": scenario.queue_capacity,
            "order": order,
            "letters": letters,
            "note": note_block(note),
            "experiences": _EXPERIENCES if experiences else "",
        }
        self.static = _STATIC.format(**said, **_ALONE)
        self.static_together = _STATIC.format(**said, **_TOGETHER)

    def experience(self, seen: Cells, sensor_id: int, velocity: int, cost: float) -> str:
        """Such as ``52,3>7:0``, the cost in tenths."""
        return f"{seen['queue']},{seen['age']}>{velocity}:{min(99, round(10 * cost))}\n"

    def offer(
        self, offer: CandidateSet, state: State, experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> Prompt:
        """The prompt for one decision, the offer's rows in their order."""
        last = "".join(nearest)
        return Prompt(
            static=self.static,
            experiences="".join(experiences),
            state=last + offer.rows,
            uncompressed=_whole(state).under(last),
        )

    def together(
        self, offers: Mapping[int, tuple[CandidateSet, State]], experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> dict[int, Prompt]:
        """Each UAV's share of one prompt about several, by number.

        The static block and the experiences are the first one's; the user message is the shares' in order.
        """
        shares = {
            uav: Prompt("", "", _list(uav, offer.numbered_rows()), _whole(state).under(_list(uav, "")))
            for uav, (offer, state) in offers.items()
        }
        uav, first = next(iter(shares.items()))
        last = "".join(nearest)
        shares[uav] = Prompt(
            static=self.static_together,
            experiences="".join(experiences),
            state=last + first.state,
            uncompressed=first.uncompressed.under(last),
        )
        return shares

    def content_free(self, uavs: Sequence[int] = ()) -> list[str]:
        """User messages with as many rows as there can be, none of which says anything; of several UAVs, by number."""
        heads = ascii_uppercase[: self.rows * self.paces : self.paces]
        if not uavs:
            return ["".join(f"{letter}{nothing}\n" for letter in heads) for nothing in _CONTENT_FREE]
        return [
            "".join(_list(uav, "".join(f"{letter}?,{nothing}\n" for letter in heads)) for uav in uavs)
            for nothing in _CONTENT_FREE
        ]

    @property
    def labels(self) -> list[str]:
        """Every letter that a prompt of this mission can offer."""
        return list(ascii_uppercase[: self.rows * self.paces])


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """What there is to choose from: ``actions`` (sensor ID, velocity), each once, in the order of the rows.

    ``labels`` names actions by index; several letters may name the same. ``rows`` is their text.
    """

    actions: list[Action]
    labels: dict[str, int]
    rows: str

    @classmethod
    def of(cls, state: State, reach: Reach, shown: Sequence[int], template: GuidedTemplate) -> Self:
        """Of the rows of a state, in the order to show them; no more than the template has letters for."""
        actions: dict[Action, int] = {}
        labels: dict[str, int] = {}
        text = []
        kept = shown[: template.rows]
        for place, (row, known) in enumerate(zip(kept, cells(state, kept), strict=True)):
            speeds = velocities(reach, row, template.paces)
            letters = ascii_uppercase[place * template.paces :][: template.paces]
            for letter, velocity in zip(letters, speeds, strict=True):
                labels[letter] = actions.setdefault(Action(int(state.ids[row]), velocity), len(actions))
            text.append(f"{letters[0]}{known['queue']},{known['age']},{_span(speeds)}\n")
        return cls(list(actions), labels, "".join(text))

    def flown_as(self, velocity: Callable[[int, int], int]) -> CandidateSet:
        """With other velocities, told by sensor and velocity; labels may come to name the same action."""
        actions: dict[Action, int] = {}
        places = [actions.setdefault(Action(s, velocity(s, v)), len(actions)) for s, v in self.actions]
        return CandidateSet(list(actions), {label: places[i] for label, i in self.labels.items()}, self.rows)

    def with_actions(self, added: Sequence[Action]) -> CandidateSet:
        """With more that no letter names."""
        known = dict.fromkeys(self.actions)
        return CandidateSet(list(known | dict.fromkeys(added)), self.labels, self.rows)

    def numbered_rows(self) -> str:
        """The rows with the sensor's ID after the letter."""
        return "".join(
            f"{row[0]}{self.actions[self.labels[row[0]]][0]},{row[1:]}" for row in self.rows.splitlines(keepends=True)
        )

    def spread(self, by_label: Mapping[str, float]) -> FloatArray:
        """Probabilities of labels as those of actions, ``(n,)``."""
        probabilities = np.zeros(len(self.actions))
        for label, probability in by_label.items():
            probabilities[self.labels[label]] += probability
        return probabilities


def velocities(reach: Reach, row: int, count: int) -> list[int]:
    """The velocities worth offering for a sensor, slowest first, ``count`` of them with repetitions.

    Evenly spaced over the span in which nearly all that can be moved is moved, its ends included: where a UAV is to be
    for its next sensors is not to be read off this one. Of one, the best by worth.
    """
    if count == 1:
        return [int(reach.best[row])]
    packets = reach.packets[:, row]
    good = np.flatnonzero(packets >= _NEARLY * packets.max())
    return [int(level) for level in np.rint(np.linspace(good[0], good[-1], count))]


def _whole(state: State) -> Uncompressed:
    return Uncompressed(state, FORMATS["csv"].row)


def _list(uav: int, rows: str) -> str:
    return f"UAV {uav}\n{rows}"


def _span(speeds: Sequence[int]) -> str:
    # Two tokens a row less where the slowest is 0, as for most.
    return f"{speeds[0]}-{speeds[-1]}" if 0 < speeds[0] < speeds[-1] else str(speeds[-1])
