"""Faults of a mission: departures, and the share of the links' rate that is lost."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.scenario import Scenario
from simulator.world.environment import PipelineWorld

LEAVING = Scenario(name="leaving", uavs=5, steps=12, departures=3)


def actions(world: PipelineWorld) -> dict[str, tuple[int, int]]:
    return {agent: (uav, 7) for agent, uav in world.live.items()}


def test_a_uav_that_leaves_is_terminated_once_and_never_seen_again() -> None:
    world = PipelineWorld(LEAVING)
    world.reset(seed=3)
    departs = world.truth.faults.departs_at
    assert np.count_nonzero(departs <= 11) == 3 and departs.min() >= 1
    for instant in range(1, 13):
        acting = world.agents
        observations, rewards, terminations, truncations, infos = world.step(actions(world))
        assert list(observations) == list(rewards) == list(infos) == list(truncations) == acting
        gone = {f"uav_{uav}" for uav in np.flatnonzero(departs == instant)}
        assert {agent for agent, over in terminations.items() if over} == gone
        assert set(truncations.values()) == {instant == 12}
        if instant < 12:
            assert world.agents == [agent for agent in acting if agent not in gone]
    assert world.agents == []


def test_a_uav_that_left_neither_flies_nor_collects_nor_fails() -> None:
    world = PipelineWorld(LEAVING.model_copy(update={"steps": 30}))
    world.reset(seed=3)
    while len(world.agents) == 5:
        world.step(actions(world))
    [gone] = set(range(5)) - set(world.live.values())
    place = world.fleet.positions[gone].copy()
    others = world.fleet.positions.copy()
    while world.agents:
        served = {sensor for sensor, _ in actions(world).values()}
        failed = sum(info["failed"] for info in world.step(actions(world))[-1].values())
        assert world.tally[-1].failures == failed
        assert set(np.flatnonzero(world.tally[-1].collected)) <= served
    np.testing.assert_array_equal(world.fleet.positions[gone], place)
    assert not np.array_equal(world.fleet.positions, others)


def test_an_action_of_a_uav_that_left_is_refused() -> None:
    world = PipelineWorld(LEAVING)
    world.reset(seed=3)
    everyone = actions(world)
    while len(world.agents) == 5:
        world.step(actions(world))
    with pytest.raises(ValueError, match=r"uav_\d: no such agent"):
        world.step(everyone)


def test_a_mission_of_one_step_has_no_departures() -> None:
    world = PipelineWorld(LEAVING.model_copy(update={"steps": 1}))
    world.reset(seed=0)
    *_, terminations, truncations, _ = world.step(actions(world))
    assert not any(terminations.values()) and all(truncations.values())


def test_a_share_of_every_rate_is_lost_from_the_middle_half_on() -> None:
    world = PipelineWorld(Scenario(link_share_drop=0.5, steps=40))
    starts = []
    for seed in range(60):
        world.reset(seed=seed)
        shares = [world.truth.faults.share(instant) for instant in range(1, 41)]
        lower = [bool(np.all(np.asarray(share) == 0.5)) for share in shares]
        assert lower == sorted(lower)
        starts.append(lower.index(True))
    assert min(starts) >= 10 and max(starts) <= 30 and max(starts) - min(starts) > 12


def test_half_of_the_rate_moves_half_of_the_packets() -> None:
    one = Scenario(
        name="one", sensors=1, uavs=1, steps=8, lap_radius_m=1.0, lap_offset_m=0.0, layout="surveyed",
        sites=((500.0, 500.0),), arrival_rate_min=60.0, arrival_rate_max=60.0,
    )  # fmt: skip
    world = PipelineWorld(one.model_copy(update={"link_share_drop": 0.5}))
    world.reset(seed=1)
    world.sensors.arrivals[:] = 60
    moved = []
    while world.agents:
        moved.append(world.step({"uav_0": (0, 0)})[-1]["uav_0"]["collected"])
    drop = int(world.truth.faults.drops_at)
    assert moved[1:] == [60 if instant < drop else 30 for instant in range(2, 9)]
    # Half of the rate is twice the airtime.
    assert world.sensors.battery[0] == pytest.approx(50.0 - moved[0] / 60 - (drop - 2) - (9 - drop), abs=1e-9)
