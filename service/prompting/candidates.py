"""Mode ``guided``: the candidate set of sensor-velocity pairs, each with choice letters of a single token.

A row of the prompt shows a sensor's first letter; the letters after it are its faster velocity options. Every row has
the same number of letters, so that the letters' positions in the prompt, and with them the LLM's bias towards letters
and positions, stay the same for a mission's life. In a prompt about several UAVs each UAV has its own rows, whose
letters begin with A. These rows name the sensor, because two UAVs may not share one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from string import ascii_uppercase
from typing import Self

import numpy as np

from shared.belief.fleet_belief import FleetBelief
from shared.features.augmented_state import Reach, State
from shared.world.step_rule import Action

# OpenAI and vLLM return the probabilities of at most 20 tokens.
MOST_LABELS = 20
_MOST_VELOCITIES = 4
# Velocities that move at least this share of the most packets are equally good for the sensor.
_NEARLY_BEST = 0.9


@dataclass(frozen=True)
class Letters:
    """A mission's choice letters: the most ``rows`` that a prompt shows, and the ``velocities`` of each row."""

    rows: int
    velocities: int

    @classmethod
    def of(cls, rows: int) -> Self:
        """Letters for the rows: 1 to 4 for each, and fewer rows where 20 letters are too few."""
        velocities = max(1, min(_MOST_VELOCITIES, MOST_LABELS // rows))
        return cls(min(rows, MOST_LABELS // velocities), velocities)

    @cached_property
    def all(self) -> str:
        """Every letter that a prompt can offer."""
        return ascii_uppercase[: self.rows * self.velocities]

    @cached_property
    def first(self) -> str:
        """The first letter of each row, which the row shows."""
        return self.all[:: self.velocities]

    def of_row(self, row: int) -> str:
        """The letters of a row, slowest velocity first."""
        return self.all[row * self.velocities :][: self.velocities]


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """The UAV that a prompt is for, the step, and its fleet's belief.

    Attributes:
        learned: whether links follow the fleet's learned channel; otherwise they follow the formula.
        nearest: the velocity nearest to one that the operator allows to the sensor in a row of the state.
    """

    belief: FleetBelief
    uav_id: int
    step: int
    learned: bool = True
    nearest: Callable[[int, int], int] = lambda row, velocity: velocity


# The text of a state's rows, from the rows, each one's first choice letter, and its velocity options, slowest first.
RowsWriter = Callable[[Sequence[int], str, Sequence[Sequence[int]]], str]


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """The actions to choose from.

    Attributes:
        actions: each action once, in the order of the rows.
        labels: the index of each letter's action; several letters may have the same action.
        rows: the text of the rows.
    """

    actions: list[Action]
    labels: dict[str, int]
    rows: str

    @classmethod
    def of(
        cls, state: State, reach: Reach, shown: Sequence[int], letters: Letters, view: Viewpoint, write: RowsWriter
    ) -> Self:
        """The candidates for these rows of a state, in this order, up to the number of letters."""
        actions: dict[Action, int] = {}
        labels: dict[str, int] = {}
        rows = shown[: letters.rows]
        options = [[view.nearest(row, v) for v in velocity_options(reach, row, letters.velocities)] for row in rows]
        for number, row in enumerate(rows):
            for letter, velocity in zip(letters.of_row(number), options[number], strict=True):
                labels[letter] = actions.setdefault(Action(int(state.ids[row]), velocity), len(actions))
        return cls(list(actions), labels, write(rows, letters.first[: len(rows)], options))

    def with_actions(self, added: Sequence[Action]) -> "CandidateSet":
        """The set with more actions, which have no letter."""
        return CandidateSet(list(dict.fromkeys([*self.actions, *added])), self.labels, self.rows)

    def numbered_rows(self) -> str:
        """The rows, with the sensor's ID after the letter."""
        return "".join(
            f"{row[0]}{self.actions[self.labels[row[0]]][0]},{row[1:]}" for row in self.rows.splitlines(keepends=True)
        )

    def by_action(self, by_label: Mapping[str, float]) -> dict[Action, float]:
        """The probabilities of the letters, added up for each action."""
        probabilities = [0.0] * len(self.actions)
        for label, probability in by_label.items():
            probabilities[self.labels[label]] += probability
        return dict(zip(self.actions, probabilities, strict=True))


def velocity_options(reach: Reach, row: int, count: int) -> list[int]:
    """``count`` velocity options for a sensor, slowest first; options may repeat.

    They are evenly spaced over the velocities that move nearly the most packets, both ends included, because the best
    position for the next sensors is open. A single option is the velocity of most worth.
    """
    if count == 1:
        return [int(reach.best[row])]
    packets = reach.packets[:, row]
    good = np.flatnonzero(packets >= _NEARLY_BEST * packets.max())
    return [int(level) for level in np.rint(np.linspace(good[0], good[-1], count))]
