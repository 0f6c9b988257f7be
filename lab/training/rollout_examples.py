"""Training examples for the modules: recorded rollouts, with the edge's own features."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Self

import numpy as np
import torch
from torch import Tensor

from lab.exploration.rollouts import Header, Reference, RolloutStep
from lab.training.recorded_states import recorded_states
from lab.training.reward import Reward, Speed
from service.config.settings import Settings
from service.deciding.advisers import look_ahead
from service.deciding.attended_state import AttendedState
from service.learning.modules import Sample
from service.mission.mission import Mission
from shared.features.augmented_state import Reach, State, distances_between, places_ahead
from shared.wire.schemas import Belief, Features, MissionSpec
from shared.world.scenario import Scenario
from shared.world.step_rule import Action


@dataclass(frozen=True, slots=True)
class TeacherDecision:
    """A teacher's decision, as a sample of the modules' inputs.

    ``reaches`` is false where the sensor cannot send a packet after the step; the sensor is then arbitrary.
    ``best_velocity`` is the velocity of one step of look-ahead for the sensor (see :attr:`Reach.best`).
    """

    teacher: str
    sample: Sample
    reaches: bool
    best_velocity: int

    def ranked(self, speed: Speed) -> Sample:
        """The sample to be ranked first, with the teacher's velocity or the best by look-ahead."""
        return self.sample if speed == "teacher" else self.sample._replace(velocity=self.best_velocity)


@dataclass(frozen=True, slots=True)
class Example:
    """A decision's sample, its reward (minus the cost), and the teacher's decision.

    ``taught`` is None where the teacher's sensor was masked. Without a recorded teacher, the look-ahead policy is the
    teacher.
    """

    sample: Sample
    reward: float
    taught: TeacherDecision | None


def replay(
    header: Header,
    steps: Iterable[RolloutStep],
    reward: Reward,
    features: Features = "paper",
    belief: Belief | None = None,
) -> Iterator[list[Example]]:
    """Each mission's examples, with the same visiting records, arrival rates, links and features as online.

    Args:
        belief: the source of the features; by default the one that missions with these features have.
    """
    settings = Settings(mode="value")
    known: Belief = belief or ("reported" if features == "paper" else "fleet")
    spec = MissionSpec(scenario=header.scenario, features=features, belief=known, planner="off", init="random")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        logged = list(group)
        by_uav: dict[int, list[RolloutStep]] = {}
        for step in logged:
            by_uav.setdefault(step.request.uav_id, []).append(step)
        rewards = {uav: iter(reward.of(own, header.scenario)) for uav, own in by_uav.items()}
        mission = Mission(mission_id, spec, settings)
        examples = []
        for step, state in recorded_states(mission, logged):
            sample = state.pending("recorded", Action(step.sensor_id, step.velocity)).sample
            worth = next(rewards[step.request.uav_id])
            if sample is not None and worth is not None:
                examples.append(Example(sample, worth, _taught(mission, state, step.reference)))
        yield examples


def _taught(mission: Mission, state: AttendedState, reference: Reference | None) -> TeacherDecision | None:
    if reference is None:
        sensor_id, velocity = look_ahead(state.state, state.reach, state.reserved)
        teacher = "look_ahead"
    else:
        sensor_id, velocity, teacher = reference.sensor_id, reference.velocity, reference.teacher
    sample = state.pending("reference", Action(sensor_id, velocity)).sample
    if sample is None:
        return None
    reach = _reach(state.state, state.uav_id, sensor_id, mission.scenario)
    return TeacherDecision(teacher, sample, bool(reach.packets[velocity, 0] >= 1), best_velocity=int(reach.best[0]))


def _reach(state: State, uav: int, sensor_id: int, scenario: Scenario) -> Reach:
    """The reach of that sensor alone, in any feature preset."""
    row = np.flatnonzero(state.ids == sensor_id)[:1]
    ahead = places_ahead(uav, state.position, state.progress_m, scenario, state.drift)
    distance = distances_between(ahead, state.places[row])
    return Reach.of(state.links(ahead, distance, row, scenario), state.queue[row], state.urgency[row])


@dataclass(frozen=True, slots=True)
class Choices:
    """B decisions: the chosen row ``(B,)``, its approach ``(B, ...)`` and the velocity level ``(B,)``."""

    chosen: Tensor
    approach: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Self:
        """One decision for each sample."""
        return cls(
            chosen=torch.tensor([sample.chosen for sample in samples]),
            approach=torch.from_numpy(np.stack([sample.approach for sample in samples])),
            velocity=torch.tensor([sample.velocity for sample in samples]),
        )

    def __getitem__(self, rows: Tensor) -> Choices:
        return Choices(self.chosen[rows], self.approach[rows], self.velocity[rows])


@dataclass(frozen=True, slots=True)
class ExampleBatch:
    """B examples: ``features`` ``(B, n, d)`` of as many sensors as the largest example has, padded with zeros.

    ``admissible`` ``(B, n)`` distinguishes sensors from padding. ``taught`` ``(B,)`` is true where there is a teacher's
    choice, and ``reaches`` ``(B,)`` where its sensor is not arbitrary. Without a choice ``teacher`` repeats ``logged``.
    ``reward`` is ``(B,)``.
    """

    features: Tensor
    admissible: Tensor
    reward: Tensor
    logged: Choices
    teacher: Choices
    taught: Tensor
    reaches: Tensor

    @classmethod
    def of(cls, examples: Sequence[Example], speed: Speed = "look_ahead") -> Self:
        """A batch of at least one example; ``speed`` selects the velocity of the teacher's choice."""
        padded = torch.nn.utils.rnn.pad_sequence(
            [torch.from_numpy(example.sample.features) for example in examples], batch_first=True
        )
        sizes = torch.tensor([len(example.sample.features) for example in examples])
        return cls(
            features=padded,
            admissible=torch.arange(padded.shape[1]) < sizes[:, None],
            reward=torch.tensor([example.reward for example in examples], dtype=torch.float32),
            logged=Choices.of([example.sample for example in examples]),
            teacher=Choices.of(
                [example.taught.ranked(speed) if example.taught else example.sample for example in examples]
            ),
            taught=torch.tensor([example.taught is not None for example in examples]),
            reaches=torch.tensor([example.taught is not None and example.taught.reaches for example in examples]),
        )

    def __len__(self) -> int:
        return len(self.reward)

    def __getitem__(self, rows: Tensor) -> ExampleBatch:
        return ExampleBatch(
            self.features[rows],
            self.admissible[rows],
            self.reward[rows],
            self.logged[rows],
            self.teacher[rows],
            self.taught[rows],
            self.reaches[rows],
        )
