"""What the modules are pretrained on: rewards of either target, and a teacher's choice as the modules would see it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, Reference, RolloutStep
from lab.training.modules import Modules
from lab.training.reward import Reward, fleet_cost
from lab.training.rollout_examples import Example, ExampleBatch, TeacherDecision, replay
from lab.training.teacher_agreement import recall, references, velocity_agreement, velocity_error
from lab.training.training_loop import losses
from service.learning.modules import Sample
from tests.support.missions import PAPER

SHORT = PAPER.model_copy(update={"steps": 12})
HEADER = Header(scenario=SHORT, missions=1, behaviour="test")


def steps() -> list[RolloutStep]:
    """One mission's, whose references are the next UAV's own decisions."""
    flown = list(explore(SHORT, 60_000))
    later = [*flown[1:], flown[0]]
    return [
        step.model_copy(
            update={"reference": Reference(teacher="planner", sensor_id=other.sensor_id, velocity=other.velocity)}
        )
        for step, other in zip(flown, later, strict=True)
    ]


def examples(reward: Reward | None = None) -> list[Example]:
    return next(replay(HEADER, steps(), reward or Reward("immediate"), "reach"))


def taught(chosen: int = 2, velocity: int = 7, teacher: str = "planner") -> TeacherDecision:
    rng = np.random.default_rng(chosen)
    sample = Sample(rng.random((8, 12), np.float32), chosen, rng.random((15, 4), np.float32), velocity)
    return TeacherDecision(teacher, sample, reaches=True, best_velocity=14)


# ---- rewards


def test_the_immediate_reward_is_the_online_updates_own() -> None:
    own = [step for step in steps() if step.request.uav_id == 1]
    assert Reward("immediate").of(own, SHORT) == [-step.cost for step in own]


def test_the_return_is_a_discounted_mean_of_what_follows_and_ends_with_the_mission() -> None:
    own = [step for step in steps() if step.request.uav_id == 1]
    costs = [fleet_cost(step, SHORT) for step in own]
    found = Reward("return", horizon=3, discount=0.5).of(own, SHORT)
    assert found[4] == pytest.approx(-(costs[4] + 0.5 * costs[5] + 0.25 * costs[6]) / 1.75)
    assert found[-2:] == [None, None]
    assert None not in found[:-2]
    assert Reward("return", horizon=len(own) + 1).of(own, SHORT) == [None] * len(own)


def test_each_uav_has_the_return_of_its_own_decisions() -> None:
    expected = {}
    for uav in range(SHORT.uavs):
        own = [step for step in steps() if step.request.uav_id == uav]
        expected[uav] = Reward("return", horizon=4).of(own, SHORT)
    seen = examples(Reward("return", horizon=4))
    assert len(seen) <= SHORT.uavs * (SHORT.steps - 3)
    assert {e.reward for e in seen} <= {r for rewards in expected.values() for r in rewards}


# ---- references


def test_a_reference_is_seen_as_it_would_have_been_decided_and_a_masked_one_not_at_all() -> None:
    found = [e.taught for e in examples() if e.taught is not None]
    assert 0 < len(found) < len(steps())
    assert {t.teacher for t in found} == {"planner"}
    assert {t.reaches for t in found} == {True, False}
    assert all(t.ranked("teacher") == t.sample for t in found)
    assert all(t.ranked("look_ahead").velocity == t.best_velocity for t in found)


def test_where_no_reference_was_recorded_the_look_ahead_policy_teaches() -> None:
    flown = [step.model_copy(update={"reference": None}) for step in steps()]
    found = [e.taught for e in next(replay(HEADER, flown, Reward("immediate"), "reach")) if e.taught is not None]
    assert found
    assert {t.teacher for t in found} == {"look_ahead"}
    assert all(t.best_velocity == t.sample.velocity for t in found if t.reaches)


def test_a_file_from_before_there_were_references_is_read() -> None:
    line = steps()[0].model_dump(exclude={"reference"})
    assert RolloutStep.model_validate(line).reference is None


def test_ranking_rewards_the_teachers_sensor_only_where_it_reaches() -> None:
    modules = Modules("reach", 15, seed=0)
    example = Example(taught().sample, -0.1, taught())
    beyond = replace(example, taught=replace(taught(), reaches=False))
    gradients = []
    for case in (example, beyond):
        modules.zero_grad()
        _, ranking = losses(modules, ExampleBatch.of([case]), temperature=0.05)
        ranking.backward()  # type: ignore[no-untyped-call]
        score = modules.attention.score.weight.grad
        gradients.append(0.0 if score is None else float(torch.linalg.vector_norm(score)))
    assert gradients[0] > 0
    assert gradients[1] == 0


# ---- recall


def test_references_are_kept_apart_by_teacher_and_only_those_that_reach() -> None:
    cases = [
        Example(taught().sample, 0.0, found)
        for found in (taught(), taught(teacher="clairvoyant"), replace(taught(), reaches=False), None)
    ]
    assert {name: len(found) for name, found in references(cases).items()} == {"clairvoyant": 1, "planner": 1}


def test_recall_is_one_where_everyone_is_kept_and_grows_with_k() -> None:
    weights, found = Modules("reach", 15, seed=0).weights(), [taught(chosen) for chosen in range(8)]
    shares = [recall(weights, found, k) for k in (1, 3, 5, 7)]
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]
    assert np.isnan(recall(weights, found, 8)), "with 8 candidates, keeping 8 is no feat"


def test_velocities_agree_with_themselves() -> None:
    weights = Modules("reach", 15, seed=0).weights()
    contexts = weights.attend(taught().sample.features).contexts([2])
    best = int(weights.velocities(contexts, taught().sample.approach[None])[0].argmax())
    assert velocity_agreement(weights, [taught(velocity=best)]) == 1
    assert velocity_error(weights, [taught(velocity=best)]) == 0
    other = best - 3 if best >= 3 else best + 3
    assert velocity_agreement(weights, [taught(velocity=other)]) == 0
    assert velocity_error(weights, [taught(velocity=other)]) == 3
