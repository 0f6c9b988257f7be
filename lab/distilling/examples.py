"""Examples for the adapter: the compact prompts of recorded flights, with a teacher's preference for every label.

A mission is shown in one of several views: with the links that the fleet has learned, or with each UAV's own reports
and the formula's links; and with no, few or many experiences. The teacher knows the learned links in all of them. Where
no sensor has anything to collect, it names any sensor, even one that fails repeatedly. So the target gives little
probability to sensors whose newest experience in the prompt is a failure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from lab.exploration.rollouts import Header, Reference, RolloutStep
from lab.training.recorded_states import recorded_states
from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet
from service.prompting.compact_prompt import SIGNS, sign
from shared.wire.schemas import Belief, MissionSpec
from shared.world.channel import FloatArray
from shared.world.step_rule import Action

# As in :mod:`lab.adapter.batches`: the share of the teacher's sensor (the rest goes by regret), packets of regret that
# make an action e times less likely, and packets that a metre a second is worth.
_REFERENCE_SHARE, _TEMPERATURE, _WORTH_OF_VELOCITY = 0.2, 0.3, 0.2 / 14
# The share that remains to a sensor whose newest experience is a failure that was not expected. In missions that the
# planner without learning flew, such a sensor failed again in 78 and 66% of the cases after one failure (`faulty`,
# `shadowed`), in 93 and 85% after two, and in 100 and 93% after more.
_AFTER_FAILURE = 0.15


@dataclass(frozen=True, slots=True)
class View:
    """The part of a fleet's past that a prompt shows: the learned ``belief`` or only reports, and the experiences."""

    belief: Belief
    experiences: int


LEARNED, UNLEARNED, EXPERIENCED = View("fleet", 0), View("reported", 0), View("reported", 8)
# The views of a file's missions, in turn. Most have a learned belief, as missions have by default.
_CYCLE = (
    LEARNED,
    EXPERIENCED,
    LEARNED,
    View("reported", 30),
    LEARNED,
    EXPERIENCED,
    View("fleet", 8),
    UNLEARNED,
    LEARNED,
    EXPERIENCED,
)


def view_of(number: int) -> View:
    """The view in which the training sees a file's mission of that number."""
    return _CYCLE[number % len(_CYCLE)]


@dataclass(frozen=True, slots=True)
class PromptExample:
    """One decision: the user message, its labels, and the teacher's probabilities of them, ``(n,)``.

    Attributes:
        sensors: the sensor of each label.
        reference: the label of the teacher's action, or of the likeliest action where the teacher's sensor has failed;
            -1 where no row has the teacher's sensor.
    """

    text: str
    labels: str
    target: FloatArray
    sensors: tuple[int, ...]
    reference: int


def failing_signs(lines: Iterable[str]) -> set[str]:
    """The signs of the sensors whose newest experience is a failure although packets were expected."""
    newest = {line[1]: line for line in lines}
    return {own for own, line in newest.items() if line[0] != "0" and line.endswith("X")}


def missions_of(steps: Iterable[RolloutStep]) -> Iterator[list[RolloutStep]]:
    """The decisions of a file, mission by mission."""
    for _, group in groupby(steps, key=lambda step: step.request.mission_id):
        yield list(group)


def prompt_examples(header: Header, logged: Sequence[RolloutStep], view: View) -> list[PromptExample]:
    """One mission's examples, in the states that an edge with this view would have had."""
    mission_id = logged[0].request.mission_id
    spec = MissionSpec.model_validate(
        {
            "scenario": header.scenario,
            "planner": "off",
            "features": "reach",
            "belief": view.belief,
            "prompt": {"format": "compact", "order": "shuffled", "experiences": view.experiences},
            "seed": int(mission_id.rpartition("-")[2]),
        }
    )
    mission = Mission(mission_id, spec, Settings(mode="guided", store="none", llm_adapter="served"))
    return [
        _example(state, step.reference)
        for step, state in recorded_states(mission, logged)
        if step.reference is not None and len(state.rows) > 1
    ]


def _example(state: AttendedState, reference: Reference) -> PromptExample:
    mission = state.mission
    template = template_of(mission)
    candidates = candidates_of(state, template)
    prompt = template.choice_prompt(candidates, state.state, mission.experiences.block)
    rollout = RolloutState.of(
        mission.belief, mission.scenario, state.step, state.uav_id, seed=mission.spec.seed, reserved=state.reserved
    )
    lost = evaluate(rollout, candidates.actions).lost
    labels = "".join(candidates.labels)
    index = np.array([candidates.labels[label] for label in labels])
    chosen = _nearest_label(candidates, labels, Action(reference.sensor_id, reference.velocity))
    target = _target(lost, candidates.actions, index, chosen)
    failing = failing_signs(mission.experiences.block)
    shunned = np.array([sign(candidates.actions[i].sensor_id) in failing for i in index])
    if shunned.any():
        target = target * np.where(shunned, _AFTER_FAILURE, 1.0)
        target /= target.sum()
        chosen = int(target.argmax()) if chosen >= 0 else -1
    return PromptExample(
        text=_with_other_signs(prompt.user, [mission.spec.seed, state.step, state.uav_id]),
        labels=labels,
        target=target,
        sensors=tuple(candidates.actions[i].sensor_id for i in index),
        reference=chosen,
    )


def _with_other_signs(text: str, seed: Sequence[int]) -> str:
    """The text with new random signs of its sensors: IDs of scenarios begin at 0, but every sign must be learned."""
    drawn = "".join(np.random.default_rng(seed).permutation(list(SIGNS)))
    return text.translate(str.maketrans(SIGNS, drawn))


def _target(lost: FloatArray, actions: Sequence[Action], index: np.ndarray, chosen: int) -> FloatArray:
    """Soft targets by regret, and a share for the reference's sensor; labels of the same action share alike.

    Of actions with equal losses the student learns the faster one, as :func:`lab.adapter.batches.targets_of` says.
    """
    sensors, velocities = np.array(actions)[index].T
    worth = lost[index] - _WORTH_OF_VELOCITY * velocities
    times = np.bincount(index, minlength=len(lost))[index]

    def by_regret(own: np.ndarray) -> FloatArray:
        weights = own * np.exp(-(worth - worth[own].min()).clip(max=15.0) / _TEMPERATURE) / times
        return np.asarray(weights / weights.sum())

    target = by_regret(np.ones_like(sensors, dtype=bool))
    if chosen >= 0:
        target = (1.0 - _REFERENCE_SHARE) * target + _REFERENCE_SHARE * by_regret(sensors == sensors[chosen])
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
