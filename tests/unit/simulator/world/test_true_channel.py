"""The true channel: the spread and the correlation of its shadowing, and radios that die."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.channel import FloatArray
from shared.world.scenario import SCENARIOS, Scenario
from simulator.world.environment import PipelineWorld
from simulator.world.sensors import Streams
from simulator.world.truth import Truth

CROWD = Scenario(name="crowd", sensors=2000)


def truth(scenario: Scenario, seed: int = 0) -> Truth:
    return Truth.draw(scenario, Streams.of(np.random.SeedSequence(seed)))


def shadowing(scenario: Scenario, position: FloatArray, seed: int = 0) -> FloatArray:
    """The excess losses from positions ``(..., 1, 2)``, ``(..., J)``."""
    found = truth(scenario, seed).channel.place_db(position, np.zeros(position.shape[:-1]))
    return np.asarray(found[..., 0, :])


def on_a_line(spacing_m: float, points: int = 40) -> FloatArray:
    """Positions ``(points, 1, 2)`` of one UAV, on a line that is no axis."""
    return np.asarray((np.arange(points)[:, None, None] * spacing_m) * np.array([0.6, 0.8]))


def test_a_sensors_own_loss_has_its_deviation_and_is_the_same_everywhere() -> None:
    excess = shadowing(CROWD.model_copy(update={"shadowing_db": 6.0}), on_a_line(100.0))
    np.testing.assert_array_equal(excess, np.broadcast_to(excess[0], excess.shape))
    assert excess[0].std() == pytest.approx(6.0, rel=0.05)
    assert abs(excess[0].mean()) < 0.5


@pytest.mark.parametrize("decorrelation_m", [20.0, 50.0, 200.0])
def test_the_loss_along_the_way_has_the_exponential_correlation(decorrelation_m: float) -> None:
    scenario = CROWD.model_copy(update={"route_shadowing_db": 4.0, "decorrelation_m": decorrelation_m})
    gaps = (0.2, 0.5, 1.0, 2.0)
    places = on_a_line(decorrelation_m, 2)[1] * np.array([0.0, *gaps])[:, None, None]
    here, *others = np.array([shadowing(scenario, places, seed) for seed in range(12)]).transpose(1, 0, 2)
    assert here.std() == pytest.approx(4.0, rel=0.05)
    for apart, there in zip(gaps, others, strict=True):
        assert np.mean(here * there) / np.mean(here * here) == pytest.approx(np.exp(-apart), abs=0.06)


def test_two_sensors_see_different_shadows_and_one_place_always_has_the_same() -> None:
    scenario = CROWD.model_copy(update={"route_shadowing_db": 4.0, "sensors": 200})
    places = on_a_line(500.0, 60)
    excess = shadowing(scenario, places)
    standard = (excess - excess.mean(axis=0)) / excess.std(axis=0)
    assert abs(np.mean((standard.T @ standard / 60)[np.triu_indices(200, 1)])) < 0.02
    np.testing.assert_array_equal(shadowing(scenario, places[::-1])[::-1], excess)


def test_beacons_report_the_loss_that_transfers_suffer() -> None:
    world = PipelineWorld(SCENARIOS["shadowed"])
    observations, _ = world.reset(seed=0)
    plain, _ = PipelineWorld().reset(seed=0)
    excess = world.truth.channel.excess_db(world.fleet.positions, world.fleet.progress_m, 0)
    for uav, agent in enumerate(world.agents):
        np.testing.assert_array_equal(observations[agent]["position"], plain[agent]["position"])
        np.testing.assert_array_equal(observations[agent]["last_heard"], plain[agent]["last_heard"])
        heard = observations[agent]["last_heard"] == 0
        more = plain[agent]["channel_gain"] - observations[agent]["channel_gain"]
        np.testing.assert_allclose(more[heard], excess[uav, heard], atol=1e-9)


def test_a_dead_radio_is_heard_and_transmits_nothing() -> None:
    scenario = Scenario(name="dead", sensors=1, uavs=1, steps=20, lap_radius_m=1.0, lap_offset_m=0.0, dead_radios=1)
    world = PipelineWorld(scenario.model_copy(update={"layout": "surveyed", "sites": ((500.0, 500.0),)}))
    world.reset(seed=2)
    dies = int(world.truth.faults.dies_at[0])
    assert 1 < dies < 20
    failed = []
    while world.agents:
        observations, _, _, _, infos = world.step({"uav_0": np.zeros(2, dtype=np.int64)})
        failed.append(infos["uav_0"]["failed"])
        if failed[-1]:
            # The fleet cannot serve it, so nobody pays for what it loses.
            assert (infos["uav_0"]["lost_packets"], infos["uav_0"]["cost"]) == (0, 1.0)
        assert observations["uav_0"]["last_heard"][0] == len(world.tally)
    assert failed == [step + 1 >= dies for step in range(20)]


def test_as_many_radios_die_as_the_scenario_says_at_steps_of_the_whole_mission() -> None:
    scenario = CROWD.model_copy(update={"dead_radios": 900})
    dies = truth(scenario).faults.dies_at
    dead = dies[dies <= scenario.steps]
    assert len(dead) == 900
    assert set(dead.tolist()) == set(range(1, scenario.steps + 1))


def test_a_loss_is_one_that_a_report_can_have_whatever_its_excess() -> None:
    channel = truth(CROWD.model_copy(update={"shadowing_db": 8.0})).channel
    links = channel.at(np.full(2, 100.0), np.array([-500.0, 500.0]), 1.0)
    assert links.loss_db.tolist() == [0.0, 400.0]
