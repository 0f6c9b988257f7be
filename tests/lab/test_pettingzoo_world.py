"""The world in PettingZoo's own tests, and its spaces."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from pettingzoo.test import (  # type: ignore[import-untyped]
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
)
from pettingzoo.utils import parallel_to_aec  # type: ignore[import-untyped]

from lab.pettingzoo_world import PettingZooWorld
from shared.world.scenario import SCENARIOS
from tests.unit.simulator.world.test_environment import SMALL


def with_steps(steps: int) -> PettingZooWorld:
    return PettingZooWorld(SCENARIOS["paper"].model_copy(update={"steps": steps}))


@pytest.mark.parametrize("name", SCENARIOS)
def test_pettingzoos_api(name: str) -> None:
    parallel_api_test(PettingZooWorld(SCENARIOS[name]), num_cycles=100)


@pytest.mark.parametrize("name", ["paper", "field"])
def test_pettingzoos_seeding(name: str) -> None:
    parallel_seed_test(lambda: PettingZooWorld(SCENARIOS[name]))


def test_pettingzoos_cycles() -> None:
    made = SimpleNamespace(
        parallel_env=lambda max_cycles: with_steps(max_cycles),
        env=lambda max_cycles: parallel_to_aec(with_steps(max_cycles)),
    )
    max_cycles_test(made)


@pytest.mark.parametrize("name", SCENARIOS)
def test_observations_and_state_stay_inside_their_spaces(name: str) -> None:
    world = PettingZooWorld(SCENARIOS[name])
    rng = np.random.default_rng(0)
    observations, _ = world.reset(seed=1)
    for _ in range(world.scenario.steps):
        for agent, observation in observations.items():
            for key, space in world.observation_space(agent).items():
                assert space.contains(observation[key]), (agent, key)  # type: ignore[literal-required]
        assert world.state_space.contains(world.state())
        actions = {a: (rng.integers(world.scenario.sensors), rng.integers(15)) for a in world.agents}
        observations, *_ = world.step(actions)


def test_state_is_laid_out_as_documented() -> None:
    world = PettingZooWorld(SMALL)
    with pytest.raises(ValueError, match="state before reset"):
        world.state()
    world.reset(seed=0)
    world.sensors.arrivals[:] = 0
    world.step({"uav_0": (0, 0), "uav_1": (2, 0)})
    state = world.state()
    assert state.shape == (1 + 2 * 2 + 4 * 3,)
    assert state.dtype == np.float32
    np.testing.assert_allclose(state[0], 0.25)
    np.testing.assert_allclose(state[1:5], world.fleet.positions.ravel() / 1000, rtol=1e-6)
    np.testing.assert_allclose(state[5:11], [0.5, 0.5, 0.5, 0.7, 0.5, 0.9], rtol=1e-6)
    np.testing.assert_allclose(state[11:14], [0.0, 1.0, 1.0])
    np.testing.assert_allclose(state[14:], [0.98, 1.0, 1.0], rtol=1e-6)


def test_the_mask_allows_the_sensors_heard_or_all() -> None:
    _, infos = PettingZooWorld(SMALL).reset(seed=0)
    assert infos["uav_0"]["action_mask"].tolist() == [1, 1, 0] + [1] * 15  # type: ignore[typeddict-item]
    _, infos = PettingZooWorld(SMALL.model_copy(update={"pipeline": ((0.0, 0.0), (10.0, 0.0))})).reset(seed=0)
    assert infos["uav_1"]["action_mask"].tolist() == [1] * 18  # type: ignore[typeddict-item]


def test_paper_cost_is_the_teams_events() -> None:
    world = PettingZooWorld(SMALL, cost="paper")
    world.reset(seed=0)
    world.sensors.arrivals[:] = (5, 7, 9)
    _, rewards, _, _, infos = world.step({"uav_0": (0, 0), "uav_1": (2, 0)})
    assert rewards == {"uav_0": -3.0, "uav_1": -3.0}
    assert [infos[agent]["lost_packets"] for agent in world.agents] == [7, 7]
