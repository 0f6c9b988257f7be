"""Training worlds: apart from every evaluation seed, with the teachers' reference actions recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lab.exploration.exploration import explore
from lab.exploration.rollouts import RolloutStep
from lab.exploration.teachers import TEACHERS, ClairvoyantTeacher, PlannerTeacher, TeacherName
from lab.training_seeds import FIRST_TRAINING_SEED
from shared.client.errors import EdgeError
from shared.world.scenario import SCENARIOS
from simulator.bound.clairvoyant_bound import clairvoyant
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from tests.support.edge_stub import stub_edge

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 12})
NAMES: list[TeacherName] = ["planner", "clairvoyant"]


def lost(steps: list[RolloutStep]) -> int:
    return sum(step.fleet_lost for step in steps[:: SHORT.uavs])


def flown_as_advised(step: RolloutStep) -> bool:
    reference = step.reference
    return reference is not None and (reference.sensor_id, reference.velocity) == (step.sensor_id, step.velocity)


@pytest.mark.parametrize("mission", [0, 1, 599])
def test_training_worlds_are_no_evaluation_worlds(mission: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    drawn = PipelineWorld.reset

    def reset(world: PipelineWorld, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        assert seed is not None
        seeds.append(seed)
        return drawn(world, seed, options)

    monkeypatch.setattr(PipelineWorld, "reset", reset)
    assert list(explore(SHORT, mission))
    # Evaluation uses seeds 0 to 999, development a few thousand more.
    assert seeds == [FIRST_TRAINING_SEED + mission]
    assert min(seeds) > 100_000


def test_without_a_teacher_there_is_no_reference() -> None:
    assert [step.reference for step in explore(SHORT, 3)] == [None] * 36


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("name", NAMES)
def test_the_same_world_is_explored_the_same_way(name: TeacherName) -> None:
    assert list(explore(SHORT, 5, name)) == list(explore(SHORT, 5, name))


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("name", NAMES)
def test_a_fleet_mostly_follows_its_teacher_and_sometimes_deviates(
    name: TeacherName, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TEACHERS[name], "deviations", 0.6)
    steps = list(explore(SHORT, 8, name))
    assert {step.reference.teacher for step in steps if step.reference} == {name}
    share = np.mean([flown_as_advised(step) for step in steps])
    assert 0.4 < share < 1


@pytest.mark.usefixtures("brief")
def test_a_planner_learns_from_every_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    learned: list[tuple[int, int, bool]] = []

    def learn(planner: PlannerTeacher, uav: int, step: int, failed: bool) -> None:
        learned.append((uav, step, failed))
        planner.belief.settle(uav, step, failed)

    monkeypatch.setattr(PlannerTeacher, "learn", learn)
    steps = list(explore(SHORT, 8, "planner"))
    assert learned == [(step.request.uav_id, step.request.step, step.failed) for step in steps]
    assert {failed for _, _, failed in learned} == {True, False}


@pytest.mark.long
def test_a_planner_has_references_after_deviations_too() -> None:
    left = [step for step in explore(SHORT, 8, "planner") if not flown_as_advised(step)]
    assert left
    assert all(step.reference is not None for step in left)


@pytest.mark.long
def test_a_planner_without_deviations_is_the_policy_mpc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlannerTeacher, "deviations", 0.0)
    steps = list(explore(SHORT, 8, "planner"))
    alone = rollout(PipelineWorld(SHORT), policy_named("mpc"), FIRST_TRAINING_SEED + 8)
    assert all(flown_as_advised(step) for step in steps)
    assert lost(steps) == sum(tally.lost_packets for tally in alone)


def test_a_clairvoyant_without_deviations_flies_one_almost_optimal_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ClairvoyantTeacher, "deviations", 0.0)
    steps = list(explore(SHORT, 9, "clairvoyant"))
    assert all(flown_as_advised(step) for step in steps)
    bound = clairvoyant(Site(SHORT), FIRST_TRAINING_SEED + 9, time_limit_s=20, workers=1)
    assert bound.lower_bound <= lost(steps) <= bound.lost_packets + 5


def test_a_clairvoyant_has_no_reference_during_deviations_and_plans_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ClairvoyantTeacher, "deviations", 0.6)
    steps = list(explore(SHORT, 8, "clairvoyant"))
    silent = {step.request.step for step in steps if step.reference is None}
    assert silent
    assert all(flown_as_advised(step) for step in steps if step.request.step not in silent)
    assert any(step > min(silent) for step in range(SHORT.steps) if step not in silent)


@pytest.mark.usefixtures("brief")
def test_an_edges_decisions_are_flown_beside_the_teachers() -> None:
    with stub_edge() as stub:
        steps = list(explore(SHORT, 8, "planner", stub.url))
    assert len(steps) == len(stub.decides) == 36
    for step, asked in zip(steps, stub.decides, strict=True):
        assert (step.request.step, step.request.uav_id) == (asked.step, asked.uav_id)
        heard = asked.sensors.id
        assert (step.sensor_id, step.velocity) == (heard[(asked.step + asked.uav_id) % len(heard)], 7)
    assert all(step.reference is not None and step.reference.teacher == "planner" for step in steps)
    # Each outcome comes with the UAV's next request; those of the last step come to nothing.
    carried = [asked.outcome for asked in stub.decides if asked.outcome is not None]
    assert [(one.cost, one.failed) for one in carried] == [(step.cost, step.failed) for step in steps[:-3]]


def test_an_edge_that_does_not_answer_ends_the_exploration() -> None:
    with pytest.raises(EdgeError, match=r"127\.0\.0\.1:1"):
        list(explore(SHORT, 8, edge="http://127.0.0.1:1"))
