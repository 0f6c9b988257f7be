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

from service.prompting.row_formats import cells
from shared.actions import Action
from shared.channel import FloatArray
from shared.features import State
from shared.reach import Reach

# OpenAI and vLLM tell the probabilities of at most 20 tokens.
_MOST_LABELS = 20
_MOST_VELOCITIES = 4
# Velocities at which at least this much of the most that can be moved is moved are all as good for the sensor.
_NEARLY = 0.9


@dataclass(frozen=True, slots=True)
class Letters:
    """A mission's letters: how many ``rows`` a prompt shows at most, and how many letters each has, for velocities."""

    rows: int
    velocities: int

    @classmethod
    def of(cls, rows: int) -> Self:
        """For as many of so many rows as there can be letters: 4 a row at the most, at least 1."""
        velocities = max(1, min(_MOST_VELOCITIES, _MOST_LABELS // rows))
        return cls(min(rows, _MOST_LABELS // velocities), velocities)

    @property
    def all(self) -> str:
        """Every letter that a prompt can offer."""
        return ascii_uppercase[: self.rows * self.velocities]

    @property
    def first(self) -> str:
        """Each row's first, the one that it shows."""
        return self.all[:: self.velocities]

    def at(self, row: int) -> str:
        """A row's, slowest to fastest."""
        return self.all[row * self.velocities :][: self.velocities]


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """What there is to choose from: ``actions`` (sensor ID, velocity), each once, in the order of the rows.

    ``labels`` names actions by index; several letters may name the same. ``rows`` is their text.
    """

    actions: list[Action]
    labels: dict[str, int]
    rows: str

    @classmethod
    def of(cls, state: State, reach: Reach, shown: Sequence[int], letters: Letters) -> Self:
        """Of the rows of a state, in the order to show them; no more than there are letters for."""
        actions: dict[Action, int] = {}
        labels: dict[str, int] = {}
        text = []
        kept = shown[: letters.rows]
        for place, (row, known) in enumerate(zip(kept, cells(state, kept), strict=True)):
            speeds = velocities(reach, row, letters.velocities)
            named = letters.at(place)
            for letter, velocity in zip(named, speeds, strict=True):
                labels[letter] = actions.setdefault(Action(int(state.ids[row]), velocity), len(actions))
            text.append(f"{named[0]}{known['queue']},{known['age']},{_span(speeds)}\n")
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


def _span(speeds: Sequence[int]) -> str:
    # Two tokens a row less where the slowest is 0, as for most.
    return f"{speeds[0]}-{speeds[-1]}" if 0 < speeds[0] < speeds[-1] else str(speeds[-1])
