"""Receding-horizon planning is reproducible, uses no hidden state, and beats simpler policies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import rollout
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.policies.registry import policy_named
from simulator.world.environment import PipelineWorld

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 5})
NONE: frozenset[int] = frozenset()


# ---- the policy


@pytest.fixture(scope="module")
def short() -> list[tuple[int, list[int]]]:
    """A mission that others are compared with."""
    return flown(SHORT, 100)


def flown(scenario: Scenario, seed: int) -> list[tuple[int, list[int]]]:
    return [
        (t.lost_packets, t.collected.tolist()) for t in rollout(PipelineWorld(scenario), RecedingHorizonPolicy(), seed)
    ]


def test_the_same_seed_is_the_same_mission_to_the_bit(short: list[tuple[int, list[int]]]) -> None:
    assert flown(SHORT, 100) == short


def test_a_policy_that_flew_before_flies_as_a_new_one(short: list[tuple[int, list[int]]]) -> None:
    policy = RecedingHorizonPolicy()
    rollout(PipelineWorld(SHORT), policy, 101)
    assert [(t.lost_packets, t.collected.tolist()) for t in rollout(PipelineWorld(SHORT), policy, 100)] == short


def test_it_loses_far_less_than_eof() -> None:
    world = PipelineWorld()
    lost = {
        name: sum(t.lost_packets for t in rollout(world, policy_named(name), 104)) for name in ("mpc", "longest_queue")
    }
    assert lost["mpc"] < 0.5 * lost["longest_queue"]


def test_unobserved_differences_do_not_change_its_decisions() -> None:
    """In two worlds with unobserved differences, the decisions are the same until a UAV observes one."""
    decisions = []
    for hidden in (0, 20):
        world, policy = PipelineWorld(SHORT), RecedingHorizonPolicy()
        observations, _ = world.reset(seed=102)
        policy.reset(SHORT, 102)
        world.sensors.queue[:] = np.minimum(world.sensors.queue + hidden, 60)
        world.sensors.arrivals[:] += hidden
        world.sensors.rates[:] += hidden
        taken = NONE
        for uav, agent in enumerate(world.agents):
            decisions.append(policy.decide(uav, observations[agent], taken))
            taken |= {decisions[-1][0]}
    assert decisions[:3] == decisions[3:]


def test_it_keeps_no_sensor_that_another_has_taken() -> None:
    world, policy = PipelineWorld(SHORT), RecedingHorizonPolicy()
    observations, _ = world.reset(seed=100)
    policy.reset(SHORT, 100)
    first, _ = policy.decide(1, observations["uav_1"], NONE)
    policy.reset(SHORT, 100)
    assert policy.decide(1, observations["uav_1"], frozenset({first}))[0] != first


def test_with_nothing_in_reach_it_still_answers() -> None:
    deaf = SHORT.model_copy(update={"radio_radius_m": 1.0})
    assert len(flown(deaf, 100)) == deaf.steps


def test_without_a_search_it_still_loses_less_than_eof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared.planning.annealing.CHANGES", 1)
    stress = SCENARIOS["stress"].model_copy(update={"steps": 12})
    longest = sum(t.lost_packets for t in rollout(PipelineWorld(stress), policy_named("longest_queue"), 101))
    assert sum(lost for lost, _ in flown(stress, 101)) < longest


@pytest.mark.parametrize("changes", [{"sensors": 1, "uavs": 1, "steps": 1}, {"sensors": 1, "uavs": 3, "steps": 3}])
def test_the_smallest_fleets_fly(changes: Any) -> None:
    assert len(flown(SHORT.model_copy(update=changes), 0)) == changes["steps"]


def test_a_fleet_of_more_uavs_than_a_plan_covers_flies() -> None:
    crowd = SCENARIOS["dense"].model_copy(update={"steps": 2, "uavs": 13, "sensors": 60})
    assert sum(sum(collected) for _, collected in flown(crowd, 100)) > 13 * 20


@pytest.mark.long
def test_a_large_fleet_loses_less_than_half_of_eofs() -> None:
    dense = SCENARIOS["dense"].model_copy(update={"steps": 10})
    longest = sum(t.lost_packets for t in rollout(PipelineWorld(dense), policy_named("longest_queue"), 100))
    assert sum(lost for lost, _ in flown(dense, 100)) < 0.5 * longest
