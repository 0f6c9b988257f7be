"""Examples for the adapter: the compact prompts of recorded flights, with a teacher's preference for every label."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.deciding.rollout_evaluator import RolloutState, evaluate
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet
from service.training.recorded_states import recorded_states
from shared.actions import Action
from shared.channel import FloatArray
from shared.rollouts import Header, Reference, RolloutStep
from shared.wire import MissionSpec

# The teacher's own action has this share of a target; the rest goes by regret.
_REFERENCE_SHARE = 0.6
# Packets of regret that make an action e times less likely.
_TEMPERATURE = 1.0


@dataclass(frozen=True, slots=True)
class PromptExample:
    """One decision: the user message, its labels, and the teacher's probabilities of them, ``(n,)``.

    Attributes:
        sensors: the sensor of each label.
        reference: the label of the teacher's action, -1 where no row has its sensor.
    """

    text: str
    labels: str
    target: FloatArray
    sensors: tuple[int, ...]
    reference: int


def prompt_examples(header: Header, steps: Iterable[RolloutStep]) -> Iterator[list[PromptExample]]:
    """Each mission's examples, in the states that the edge would have had."""
    settings = Settings(mode="guided", store="none", llm_adapter="served")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        logged = list(group)
        seed = int(mission_id.rpartition("-")[2])
        spec = MissionSpec.model_validate(
            {
                "scenario": header.scenario,
                "planner": "off",
                "prompt": {"format": "compact", "order": "shuffled"},
                "seed": seed,
            }
        )
        mission = Mission(mission_id, spec, settings)
        yield [
            _example(state, step.reference)
            for step, state in recorded_states(mission, logged)
            if step.reference is not None and len(state.rows) > 1
        ]


def _example(state: AttendedState, reference: Reference) -> PromptExample:
    mission = state.mission
    candidates = candidates_of(state, template_of(mission))
    rollout = RolloutState.of(
        mission.belief, mission.scenario, state.step, state.uav_id, seed=mission.spec.seed, reserved=state.reserved
    )
    lost = evaluate(rollout, candidates.actions).lost
    labels = "".join(candidates.labels)
    index = np.array([candidates.labels[label] for label in labels])
    chosen = _nearest_label(candidates, labels, Action(reference.sensor_id, reference.velocity))
    return PromptExample(
        text=candidates.rows,
        labels=labels,
        target=_target(lost, index, chosen),
        sensors=tuple(candidates.actions[i].sensor_id for i in index),
        reference=chosen,
    )


def _target(lost: FloatArray, index: np.ndarray, chosen: int) -> FloatArray:
    """Soft targets by regret, and the reference's share; labels of the same action share alike."""
    times = np.bincount(index, minlength=len(lost))
    by_regret = np.exp(-(lost - lost.min()) / _TEMPERATURE)
    by_regret /= by_regret.sum()
    target = (by_regret / np.maximum(times, 1))[index]
    target /= target.sum()
    if chosen >= 0:
        same = index == index[chosen]
        target = (1.0 - _REFERENCE_SHARE) * target + _REFERENCE_SHARE * same / same.sum()
    return np.asarray(target)


def _nearest_label(candidates: CandidateSet, labels: Sequence[str], action: Action) -> int:
    """The place of the label with the action's sensor and the nearest velocity; -1 without the sensor."""
    own = [
        i
        for i, label in enumerate(labels)
        if candidates.actions[candidates.labels[label]].sensor_id == action.sensor_id
    ]
    return min(
        own, key=lambda i: abs(candidates.actions[candidates.labels[labels[i]]].velocity - action.velocity), default=-1
    )
