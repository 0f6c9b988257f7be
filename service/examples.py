"""What the modules are pretrained on: recorded rollouts, seen again through the edge's own features."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Self

import numpy as np
import torch
from torch import Tensor

from service.learner import Sample
from service.mission import Mission
from service.policy import decide_without_llm
from service.settings import Settings
from service.view import View
from shared.rollouts import Header, RolloutStep
from shared.scenario import Scenario
from shared.wire import Features, MissionSpec, Outcome


@dataclass(frozen=True, slots=True)
class Example:
    """A decision as the modules saw it, the return that followed (minus the discounted cost), and the teacher's.

    ``teacher`` is what the look-ahead policy would have decided from the same view; None where its sensor was masked.
    """

    sample: Sample
    reward: float
    teacher: Sample | None


def replay(
    header: Header, steps: Iterable[RolloutStep], horizon: int, discount: float, features: Features = "paper"
) -> Iterator[list[Example]]:
    """Each mission's examples, by the same visiting records, arrival rates and features as online."""
    settings = Settings(mode="value")
    spec = MissionSpec(scenario=header.scenario, features=features, init="random")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        logged = list(group)
        costs: dict[int, list[float]] = {}
        for step in logged:
            costs.setdefault(step.request.uav_id, []).append(fleet_cost(step, header.scenario))
        mission = Mission(mission_id, spec, settings)
        examples, turn = [], dict.fromkeys(costs, 0)
        for number, step in enumerate(logged):
            uav, decision_id = step.request.uav_id, f"{number:032x}"
            mission.observe(step.request)
            view = View.of(mission, step.request, step.request.step)
            view.attend(mission)
            reserved = mission.reserved(view.step, uav)
            sensor, velocity = decide_without_llm(view.state, uav, mission.scenario, reserved)
            teacher = view.pending(mission, decision_id, sensor, velocity).sample
            mission.commit(view.pending(mission, decision_id, step.sensor_id, step.velocity))
            sample = mission.apply(Outcome(decision_id=decision_id, cost=step.cost, failed=step.failed))
            ahead = costs[uav][turn[uav] : turn[uav] + horizon]
            turn[uav] += 1
            if sample is not None and len(ahead) == horizon:
                weights = [discount**n for n in range(horizon)]
                reward = -sum(w * c for w, c in zip(weights, ahead, strict=True)) / sum(weights)
                examples.append(Example(sample, reward, teacher))
        yield examples


def fleet_cost(step: RolloutStep, scenario: Scenario) -> float:
    """``f + lost / (W I)``: a UAV's failure and its share of all that the fleet lost in the step.

    Its own c would teach it to hover: what overflows out of its reach costs it nothing.
    """
    return float(step.failed) + step.fleet_lost / (scenario.queue_capacity * scenario.uavs)


@dataclass(frozen=True, slots=True)
class Choices:
    """B decisions: the row chosen ``(B,)``, its approach ``(B, ...)`` and the velocity level ``(B,)``."""

    chosen: Tensor
    approach: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Self:
        """Samples one after another."""
        return cls(
            chosen=torch.tensor([sample.chosen for sample in samples]),
            approach=torch.from_numpy(np.stack([sample.approach for sample in samples])),
            velocity=torch.tensor([sample.velocity for sample in samples]),
        )

    def __getitem__(self, rows: Tensor) -> Choices:
        return Choices(self.chosen[rows], self.approach[rows], self.velocity[rows])


@dataclass(frozen=True, slots=True)
class Batch:
    """B examples in one: ``features`` ``(B, n, d)`` of as many sensors as the widest has, padded with zeros.

    ``admissible`` ``(B, n)`` tells sensors from padding, ``reward`` ``(B,)``, ``taught`` ``(B,)`` whether there is a
    teacher's choice; where there is none, ``teacher`` repeats ``logged``.
    """

    features: Tensor
    admissible: Tensor
    reward: Tensor
    logged: Choices
    teacher: Choices
    taught: Tensor

    @classmethod
    def of(cls, examples: Sequence[Example]) -> Self:
        """Examples one after another; at least one."""
        padded = torch.nn.utils.rnn.pad_sequence(
            [torch.from_numpy(example.sample.features) for example in examples], batch_first=True
        )
        sizes = torch.tensor([len(example.sample.features) for example in examples])
        return cls(
            features=padded,
            admissible=torch.arange(padded.shape[1]) < sizes[:, None],
            reward=torch.tensor([example.reward for example in examples], dtype=torch.float32),
            logged=Choices.of([example.sample for example in examples]),
            teacher=Choices.of([example.teacher or example.sample for example in examples]),
            taught=torch.tensor([example.teacher is not None for example in examples]),
        )

    def __len__(self) -> int:
        return len(self.reward)

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(
            self.features[rows],
            self.admissible[rows],
            self.reward[rows],
            self.logged[rows],
            self.teacher[rows],
            self.taught[rows],
        )
