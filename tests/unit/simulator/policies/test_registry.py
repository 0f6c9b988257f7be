"""The hand-written policies, on observations written by hand."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shared.world.channel import channel_gain_db
from shared.world.scenario import SCENARIOS, Scenario
from simulator.errors import UsageError
from simulator.flying.flight import rollout
from simulator.policies.registry import POLICY_NAMES, Policy, policy_named
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation

FOUR = Scenario(name="four", sensors=4, uavs=2)
NONE: frozenset[int] = frozenset()


def seen(queue: list[float], last_heard: list[int], distance: list[float] | None = None, now: int = 5) -> Observation:
    """A UAV at the origin and four sensors due east of it."""
    away = np.array(distance or [100.0] * 4)
    heard = np.array(last_heard)
    return Observation(
        step=np.array([now]),
        position=np.zeros(2),
        progress=np.zeros(1),
        sensor_position=np.stack((away, np.zeros(4)), axis=-1),
        queue=np.where(heard >= 0, queue, 0.0),
        battery=np.where(heard >= 0, 50.0, 0.0),
        channel_gain=np.where(heard >= 0, channel_gain_db(away, FOUR), 0.0),
        last_heard=heard,
    )


def ready(name: str, scenario: Scenario = FOUR, seed: int = 0) -> Policy:
    policy = policy_named(name)
    policy.reset(scenario, seed)
    return policy


def test_an_unknown_policy_lists_the_known_ones() -> None:
    assert POLICY_NAMES == (
        "random",
        "round_robin",
        "eof",
        "wqcs",
        "eof_coordinated",
        "wqcs_coordinated",
        "longest_queue",
        "queue_and_channel",
        "max_gain",
        "nearest",
        "mpc",
    )
    with pytest.raises(
        ValueError, match="unknown policy 'best': choose one of random, round_robin, eof, wqcs, eof_coordinated"
    ):
        policy_named("best")


def test_a_policy_of_ones_own_is_found_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_policy.py").write_text(
        "class First:\n"
        "    def reset(self, scenario, seed): pass\n"
        "    def decide(self, uav, observation, taken): return min({0, 1, 2, 3} - taken), 3\n"
        "class Half:\n"
        "    def reset(self, scenario, seed): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert ready("own_policy:First").decide(0, seen([30, 60, 50, 40], [5, 4, 5, 5]), frozenset({0})) == (1, 3)
    for name, fault in (
        ("own_policy:Half", "it has no method decide"),
        ("own_policy:Nothing", "has no attribute 'Nothing'"),
        ("no_such_policy:First", "No module named 'no_such_policy'"),
    ):
        with pytest.raises(UsageError, match=f"policy {name}: .*{fault}"):
            policy_named(name)


def test_the_longest_queue_is_that_of_a_sensor_in_range() -> None:
    # Sensor 1 is fuller, but was last heard a step ago: it is out of range now.
    assert ready("longest_queue").decide(0, seen([30, 60, 50, 40], [5, 4, 5, 5]), NONE) == (2, 7)


def test_the_longest_queue_is_free() -> None:
    assert ready("longest_queue").decide(1, seen([30, 60, 50, 40], [5, 4, 5, 5]), frozenset({2})) == (3, 7)


@pytest.mark.parametrize(
    "name", ["eof_coordinated", "wqcs_coordinated", "longest_queue", "queue_and_channel", "max_gain"]
)
def test_with_nothing_in_range_the_longest_silent_sensor(name: str) -> None:
    policy = ready(name)
    assert policy.decide(0, seen([60, 1, 60, 60], [4, 2, 3, 4]), NONE)[0] == 1
    assert policy.decide(0, seen([60, 1, 60, 60], [4, 2, 3, -1]), NONE)[0] == 3
    assert policy.decide(0, seen([60, 1, 60, 60], [4, 2, 3, -1]), frozenset({3}))[0] == 1
    assert policy.decide(0, seen([0, 0, 0, 0], [-1, -1, -1, -1], [900, 700, 400, 800]), NONE)[0] == 2


def test_queue_and_channel_weighs_queue_against_channel() -> None:
    policy = ready("queue_and_channel")
    near_and_half = seen([30, 60, 0, 0], [5, 5, 5, 5], [0, 350, 350, 350])
    assert policy.decide(0, near_and_half, NONE)[0] == 0
    near_and_empty = seen([0, 60, 0, 0], [5, 5, 5, 5], [100, 200, 350, 350])
    assert policy.decide(0, near_and_empty, NONE)[0] == 1
    assert policy.decide(0, near_and_empty, frozenset({1}))[0] == 0


@pytest.mark.parametrize("name", ["wqcs", "queue_and_channel"])
def test_a_better_sensor_out_of_range_is_left(name: str) -> None:
    assert ready(name).decide(0, seen([60, 10, 10, 10], [4, 5, 5, 5], [0, 300, 200, 350]), NONE)[0] == 2


def test_max_gain_takes_the_best_channel_in_range_however_empty_its_queue() -> None:
    policy = ready("max_gain")
    # Sensor 0 had the best channel a step ago: it is out of range now.
    observation = seen([60, 60, 0, 60], [4, 5, 5, 5], [20, 300, 100, 200])
    assert [policy.decide(0, observation, NONE) for _ in range(2)] == [(2, 7)] * 2
    assert policy.decide(0, observation, frozenset({2})) == (3, 7)


def test_nearest_neighbour_cycles_through_the_sensors_in_range() -> None:
    policy = ready("nearest")
    in_range = seen([60, 0, 60, 60], [5, 5, 5, 4], [300, 100, 200, 50])
    assert [policy.decide(0, in_range, NONE) for _ in range(7)] == [(s, 7) for s in (1, 2, 0, 1, 2, 0, 1)]


def test_each_uav_has_its_own_rounds() -> None:
    policy = ready("nearest")
    in_range = seen([60] * 4, [5] * 4, [300, 100, 200, 350])
    assert policy.decide(0, in_range, NONE)[0] == policy.decide(1, in_range, NONE)[0] == 1
    assert policy.decide(1, in_range, frozenset({2}))[0] == 0


def test_a_sensor_that_comes_into_range_is_part_of_the_round() -> None:
    policy = ready("nearest")
    assert policy.decide(0, seen([60] * 4, [5, 5, 4, 4], [200, 100, 300, 300]), NONE)[0] == 1
    assert policy.decide(0, seen([60] * 4, [5, 5, 5, 4], [200, 100, 150, 300]), NONE)[0] == 2
    assert policy.decide(0, seen([60] * 4, [5, 5, 5, 4], [200, 100, 150, 300]), NONE)[0] == 0


def test_with_nothing_in_range_the_nearest_neighbour_is_the_nearest_free() -> None:
    policy = ready("nearest")
    out_of_range = seen([60, 1, 60, 60], [4, 2, -1, 4], [900, 700, 400, 800])
    assert [policy.decide(0, out_of_range, NONE)[0] for _ in range(2)] == [2, 2]
    assert policy.decide(0, out_of_range, frozenset({2}))[0] == 1


def test_a_reset_begins_a_new_round() -> None:
    policy, in_range = ready("nearest"), seen([60] * 4, [5] * 4, [300, 100, 200, 350])
    assert policy.decide(0, in_range, NONE)[0] == 1
    policy.reset(FOUR, 1)
    assert policy.decide(0, in_range, NONE)[0] == 1


def test_round_robin_cycles_through_the_sensors() -> None:
    policy = ready("round_robin")
    order = [[policy.decide(uav, seen([0] * 4, [-1] * 4, now=t), NONE) for t in range(5)] for uav in (0, 1)]
    assert order[0] == [(0, 7), (1, 7), (2, 7), (3, 7), (0, 7)]
    assert [sensor for sensor, _ in order[1]] == [2, 3, 0, 1, 2]
    assert policy.decide(0, seen([0] * 4, [-1] * 4, now=3), frozenset({3, 0}))[0] == 1


def test_random_is_uniform_over_free_sensors_and_velocities() -> None:
    policy = ready("random")
    drawn = np.array([policy.decide(0, seen([0] * 4, [-1] * 4), frozenset({1})) for _ in range(3000)])
    assert set(drawn[:, 0]) == {0, 2, 3}
    assert set(drawn[:, 1]) == set(range(15))
    assert np.bincount(drawn[:, 0])[[0, 2, 3]].min() > 850
    assert np.bincount(drawn[:, 1]).min() > 120


def test_random_repeats_with_its_seed_and_not_with_another() -> None:
    def first(seed: int) -> list[tuple[int, int]]:
        policy = ready("random", seed=seed)
        return [policy.decide(0, seen([0] * 4, [-1] * 4), NONE) for _ in range(20)]

    assert first(1) == first(1)
    assert first(1) != first(2)


@pytest.mark.parametrize("name", POLICY_NAMES)
def test_with_every_sensor_taken_a_policy_still_answers(name: str) -> None:
    sensor, velocity = ready(name).decide(1, seen([9, 9, 9, 9], [5, 5, 5, 5]), frozenset(range(4)))
    assert 0 <= sensor < 4
    assert 0 <= velocity <= 14


@pytest.mark.parametrize("name", POLICY_NAMES)
def test_a_policy_keeps_to_a_lower_limit_of_velocity(name: str) -> None:
    policy = ready(name, FOUR.model_copy(update={"max_velocity": 3}))
    assert all(policy.decide(0, seen([9] * 4, [5] * 4), NONE)[1] <= 3 for _ in range(50))


@pytest.mark.parametrize("name", POLICY_NAMES)
def test_a_policy_leaves_the_observation_alone(name: str) -> None:
    observation: Any = seen([30, 60, 50, 40], [5, 4, 5, -1])
    before = {key: value.copy() for key, value in observation.items()}
    ready(name).decide(0, observation, frozenset({2}))
    np.testing.assert_equal(observation, before)


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("policy", POLICY_NAMES)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_policy_flies_every_preset(scenario: str, policy: str) -> None:
    short = SCENARIOS[scenario].model_copy(update={"steps": 5})
    tally = rollout(PipelineWorld(short), policy_named(policy), seed=0)
    assert [t.step for t in tally] == list(range(5))
    assert sum(int(t.collected.sum()) for t in tally) > 0


def test_on_paper_the_informed_policies_lose_least() -> None:
    world = PipelineWorld()
    lost = {
        name: sum(t.lost_packets for seed in range(5) for t in rollout(world, policy_named(name), seed))
        for name in ("wqcs", "longest_queue", "queue_and_channel", "round_robin", "random")
    }
    assert list(lost) == sorted(lost, key=lambda name: lost[name])
