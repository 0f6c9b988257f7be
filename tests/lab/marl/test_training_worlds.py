"""A batch of worlds has the numbers of the same worlds flown one by one, to the bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lab.marl.training_worlds import TrainingWorlds, events_of, state_of
from lab.pettingzoo_world import PettingZooWorld
from shared.world.scenario import SCENARIOS, Scenario

ROUTES = Scenario(
    name="routes",
    sensors=6,
    uavs=2,
    steps=20,
    routes=(((100.0, 100.0), (900.0, 150.0), (500.0, 800.0), (100.0, 100.0)), ((200.0, 900.0), (800.0, 300.0))),
)
FLAT = Scenario(name="flat", battery_j=1.5)
NO_RATE = Scenario(name="no_rate", packet_bits=1e12, steps=5)
PLENTY = Scenario(name="plenty", battery_j=1e9, transmit_power_w=1e-6, packet_bits=1.0, bandwidth_hz=1e12, steps=5)
SCATTERED = Scenario(name="scattered", area_m=2000.0, steps=12)
DEAD = SCENARIOS["shadowed"].model_copy(update={"name": "dead", "dead_radios": 4})
LEAVING = SCENARIOS["dense"].model_copy(update={"name": "leaving", "departures": 6, "gust_mps": 9.0, "wind_mps": 9.0})
GONE = {"failed": False, "collected": 0, "lost_packets": 0}
WORLDS = [*SCENARIOS.values(), DEAD, LEAVING, ROUTES, FLAT, NO_RATE, PLENTY, SCATTERED]


def actions_of(scenario: Scenario, seeds: range) -> tuple[Any, Any]:
    """Random sensors and velocities, each ``(T, B, I)``; UAVs often want the same sensor."""
    rng = np.random.default_rng(len(seeds))
    shape = (scenario.steps, len(seeds), scenario.uavs)
    return rng.integers(min(scenario.sensors, 12), size=shape), rng.integers(scenario.max_velocity + 1, size=shape)


def same(batched: dict[str, Any], world: int, single: dict[str, Any]) -> None:
    for agent, observation in single.items():
        uav = int(agent.removeprefix("uav_"))
        for key, value in observation.items():
            np.testing.assert_array_equal(batched[key][world, uav], value, err_msg=f"{key} of UAV {uav}", strict=True)


@pytest.mark.parametrize("scenario", WORLDS, ids=lambda part: part.name)
def test_every_number_is_that_of_the_single_world(scenario: Scenario) -> None:
    seeds = range(3) if scenario.sensors < 50 else range(2)
    batch = TrainingWorlds(scenario)
    observation: Any = batch.reset(seeds)
    singles = [PettingZooWorld(scenario) for _ in seeds]
    for index, (seed, world) in enumerate(zip(seeds, singles, strict=True)):
        same(observation, index, world.reset(seed=seed)[0])
    sensors, velocities = actions_of(scenario, seeds)
    for step in range(scenario.steps):
        observation, outcome = batch.step(sensors[step], velocities[step])
        for index, world in enumerate(singles):
            pairs = np.stack((sensors[step, index], velocities[step, index]), axis=-1)
            alone, rewards, _, over, infos = world.step({agent: pairs[uav] for agent, uav in world.live.items()})
            same(observation, index, alone)
            tally = world.tally[-1]
            of_all: Any = {f"uav_{uav}": GONE for uav in range(scenario.uavs)} | infos
            assert outcome.cost[index].tolist() == [-rewards.get(agent, -0.0) for agent in of_all]
            assert events_of(outcome)[index] == tally.events
            assert outcome.failed[index].tolist() == [info["failed"] for info in of_all.values()]
            assert outcome.moved[index].tolist() == [info["collected"] for info in of_all.values()]
            assert outcome.blamed[index].tolist() == [info["lost_packets"] for info in of_all.values()]
            np.testing.assert_equal(vars(outcome.tally(index, step)), vars(tally))
            np.testing.assert_array_equal(state_of(batch)[index], world.state(), strict=True)
            assert set(over.values()) == {batch.steps_flown == scenario.steps}


def test_the_worlds_compared_do_run_flat_collide_and_overflow() -> None:
    batch = TrainingWorlds(FLAT)
    batch.reset(range(5))
    sensors, velocities = actions_of(FLAT, range(5))
    steps = [batch.step(*pair)[1] for pair in zip(sensors, velocities, strict=True)]
    assert np.any(batch.sensors.battery < 0.02)
    assert any(np.any(step.failed) for step in steps)
    assert any(np.any(step.lost_packets) for step in steps)
    assert np.any(np.diff(np.sort(sensors, axis=2), axis=2) == 0)


def test_a_world_does_not_depend_on_its_neighbours() -> None:
    sensors, velocities = actions_of(SCENARIOS["paper"], range(5))
    five, two = TrainingWorlds(), TrainingWorlds()
    five.reset(range(5))
    two.reset([3, 1])
    for step in range(30):
        _, of_five = five.step(sensors[step], velocities[step])
        _, of_two = two.step(sensors[step][[3, 1]], velocities[step][[3, 1]])
        assert of_five.cost[[3, 1]].tolist() == of_two.cost.tolist()


def test_bad_use_is_refused_and_changes_nothing() -> None:
    batch = TrainingWorlds(Scenario(name="short", steps=1))
    idle = np.zeros((2, 3), dtype=np.int64)
    with pytest.raises(ValueError, match="step before reset"):
        batch.step(idle, idle)
    with pytest.raises(ValueError, match="state before reset"):
        state_of(batch)
    batch.reset([0, 1])
    for sensors, velocities, message in (
        (idle + 10, idle, r"sensors are not all in 0\.\.9"),
        (idle, idle - 1, r"velocities are not all in 0\.\.14"),
        (idle[:1], idle, r"sensors of shape \(1, 3\) and type int64, not integers \(2, 3\)"),
        (idle, idle + 0.5, r"velocities of shape \(2, 3\) and type float64, not integers \(2, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            batch.step(sensors, velocities)
    assert batch.steps_flown == 0
    batch.step(idle, idle)
    with pytest.raises(ValueError, match="step after the mission's end: reset first"):
        batch.step(idle, idle)
