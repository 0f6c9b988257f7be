"""The actors' input: equal in training and in a mission, and without hidden state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lab.marl.network_inputs import ActorInput, actor_input, fleet_input, mask_without, taken_mask, width
from lab.marl.training_worlds import TrainingWorlds
from shared.world.scenario import SCENARIOS, Scenario
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation

PAPER = SCENARIOS["paper"]
ROUTES = Scenario(
    name="routes", sensors=6, uavs=2, routes=(((100.0, 100.0), (900.0, 150.0)), ((200.0, 900.0), (800.0, 300.0)))
)


def flown(scenario: Scenario, steps: int = 6, seed: int = 0) -> tuple[PipelineWorld, dict[str, Observation]]:
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        actions = {agent: np.array([rng.integers(scenario.sensors), 9]) for agent in world.agents}
        observations, *_ = world.step(actions)
    return world, observations


@pytest.mark.parametrize("scenario", [PAPER, SCENARIOS["stress"], ROUTES], ids=lambda scenario: scenario.name)
def test_a_missions_features_equal_those_of_training_to_the_bit(scenario: Scenario) -> None:
    batch = TrainingWorlds(scenario)
    seen: Any = batch.reset(range(3))
    singles = [PipelineWorld(scenario) for _ in range(3)]
    alone: Any = [world.reset(seed=seed)[0] for seed, world in enumerate(singles)]
    rng = np.random.default_rng(1)
    for _ in range(scenario.steps):
        trained = fleet_input(scenario, seen)
        arrays: tuple[Any, ...] = trained
        assert trained.features.shape == (3, scenario.uavs, width(scenario))
        assert trained.features.dtype == np.float32
        for world, observations in enumerate(alone):
            for uav in range(scenario.uavs):
                observation = observations[f"uav_{uav}"]
                for ours, theirs in zip(actor_input(scenario, uav, observation), arrays, strict=True):
                    np.testing.assert_array_equal(ours, theirs[world, uav], strict=True)
        actions = rng.integers((scenario.sensors, 15), size=(3, scenario.uavs, 2))
        seen, _ = batch.step(actions[..., 0], actions[..., 1])
        alone = [
            world.step(dict(zip(world.agents, chosen, strict=True)))[0]
            for world, chosen in zip(singles, actions, strict=True)
        ]


def test_features_are_independent_of_sensors_out_of_range() -> None:
    world, observations = flown(PAPER)
    unheard = observations["uav_0"]["last_heard"] < len(world.tally)
    assert unheard.any()
    before = actor_input(PAPER, 0, observations["uav_0"])
    world.sensors.queue[unheard] = 0
    world.sensors.battery[unheard] = 0.0
    np.testing.assert_array_equal(actor_input(PAPER, 0, observations["uav_0"]).features, before.features)


def test_values_are_of_the_order_of_one() -> None:
    _, observations = flown(PAPER)
    for uav, observation in enumerate(observations.values()):
        assert np.abs(actor_input(PAPER, uav, observation).features).max() < 4


def test_the_first_slot_is_the_sensor_with_most_to_collect_next() -> None:
    _, observations = flown(PAPER)
    observation = observations["uav_0"]
    slots = actor_input(PAPER, 0, observation)
    assert sorted(slots.order.tolist()) == list(range(10))
    near = observation["last_heard"] == observation["step"]
    fullest = int(np.argmax(np.where(near, observation["queue"], -1)))
    assert fullest in slots.order[:3]


def test_only_sensors_heard_may_be_chosen_unless_none_was() -> None:
    _, observations = flown(PAPER)
    observation = observations["uav_1"]
    slots = actor_input(PAPER, 1, observation)
    assert slots.mask[:10].tolist() == (observation["last_heard"][slots.order] >= 0).tolist()
    assert slots.mask[10:].all()
    nothing: Any = {**observation, "last_heard": np.full(10, -1), "queue": np.zeros(10), "battery": np.zeros(10)}
    assert actor_input(PAPER, 1, nothing).mask.all()


def masked(mask: list[int], taken: set[int]) -> list[int]:
    slots = ActorInput(np.zeros(1, np.float32), np.array([*mask, 1, 1], dtype=bool), np.array([2, 0, 1]))
    return [int(free) for free in mask_without(slots, taken_mask(taken, 3))]


def test_a_sensor_taken_may_not_be_chosen() -> None:
    assert masked([1, 1, 1], set()) == [1, 1, 1, 1, 1]
    assert masked([1, 1, 1], {0}) == [1, 0, 1, 1, 1]
    assert masked([1, 0, 1], {2}) == [0, 0, 1, 1, 1]


def test_with_all_known_sensors_taken_a_free_one_and_with_all_taken_any() -> None:
    assert masked([1, 0, 0], {2}) == [0, 1, 1, 1, 1]
    assert masked([1, 1, 0], {0, 1, 2}) == [1, 1, 1, 1, 1]
