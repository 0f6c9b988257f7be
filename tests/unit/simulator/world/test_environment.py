"""The world: small worlds computed by hand, and faults."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.belief.fleet_belief import FleetBelief
from shared.world.channel import channel_gain_db
from shared.world.scenario import SCENARIOS, Scenario
from simulator.world.environment import PipelineWorld

# Every UAV circles within 1 m of the centre; sensors 0, 1 and 2 are 0, 200 and 400 m north of it.
SMALL = Scenario(
    name="small",
    sensors=3,
    uavs=2,
    steps=4,
    layout="pipeline",
    pipeline=((500.0, 500.0), (500.0, 900.0)),
    pipeline_spread_m=0.0,
    lap_radius_m=1.0,
    lap_offset_m=0.0,
    initial_queue_min=1.0,
)


def small_world(arrivals: Any = (0, 0, 0), **changes: Any) -> PipelineWorld:
    """A reset small world with the same known arrivals in every step."""
    world = PipelineWorld(SMALL.model_copy(update=changes))
    world.reset(seed=0)
    world.sensors.arrivals[:] = arrivals
    return world


def step(world: PipelineWorld, *actions: tuple[int, int]) -> Any:
    return world.step({f"uav_{i}": action for i, action in enumerate(actions)})


def with_steps(steps: int) -> PipelineWorld:
    return PipelineWorld(SMALL.model_copy(update={"steps": steps}))


# ---- one step, by hand


def test_collects_the_whole_queue_overhead() -> None:
    world = small_world()
    _, rewards, _, _, infos = step(world, (0, 0), (1, 0))
    assert world.sensors.queue.tolist() == [0, 0, 60]
    assert [infos[a]["collected"] for a in world.agents] == [60, 60]
    assert rewards == {"uav_0": 0.0, "uav_1": 0.0}
    assert world.tally[0].collected.tolist() == [60, 60, 0]
    assert (world.tally[0].failures, world.tally[0].overflows, world.tally[0].lost_packets) == (0, 0, 0)


def test_collects_no_more_than_the_rate_allows() -> None:
    world = small_world(link_share=0.35)
    step(world, (0, 0), (1, 0))
    assert world.sensors.queue.tolist() == [39, 39, 60]


def test_energy_is_power_times_airtime() -> None:
    world = small_world()
    step(world, (0, 0), (2, 0))
    # 60 packets of 1 Mbit at 6 Mbit/s take 10 s at 0.1 W; a failed transmission costs nothing.
    np.testing.assert_allclose(world.sensors.battery, [49.0, 50.0, 50.0])


def test_out_of_radius_fails() -> None:
    world = small_world()
    _, rewards, _, _, infos = step(world, (2, 0), (0, 0))
    assert (infos["uav_0"]["failed"], infos["uav_0"]["collected"], rewards["uav_0"]) == (True, 0, -1.0)
    assert infos["uav_1"]["failed"] is False
    assert world.tally[0].failures == 1
    assert world.sensors.queue.tolist() == [0, 60, 60]


def test_past_the_threshold_fails_inside_the_radius() -> None:
    world = small_world(path_loss_limit_db=95.0)
    _, _, _, _, infos = step(world, (1, 0), (0, 0))
    assert [infos[a]["failed"] for a in world.agents] == [True, False]


def test_the_second_uav_at_one_sensor_fails() -> None:
    world = small_world(link_share=0.35)
    _, _, _, _, infos = step(world, (1, 0), (1, 0))
    assert [infos[a]["failed"] for a in world.agents] == [False, True]
    assert [infos[a]["collected"] for a in world.agents] == [21, 0]
    assert world.sensors.queue.tolist() == [60, 39, 60]
    _, _, _, _, infos = step(world, (1, 0), (0, 0))
    assert infos["uav_0"]["failed"] is False


def test_a_failed_uav_does_not_block_its_sensor() -> None:
    # Laps 400 m apart along y: uav_0 north of the centre, uav_1 south; sensor 0 is overhead of uav_1 alone.
    world = small_world(lap_offset_m=200.0, pipeline=((500.0, 300.0), (500.0, 700.0)))
    _, _, _, _, infos = step(world, (0, 0), (0, 0))
    assert [infos[a]["failed"] for a in world.agents] == [True, False]


def test_an_empty_queue_is_no_failure() -> None:
    world = small_world()
    step(world, (0, 0), (1, 0))
    _, _, _, _, infos = step(world, (0, 0), (1, 0))
    assert [(infos[a]["failed"], infos[a]["collected"]) for a in world.agents] == [(False, 0), (False, 0)]


def test_the_remaining_battery_limits_a_transfer_and_a_flat_one_sends_nothing() -> None:
    # A packet overhead costs 1/60 J, so 0.5 J pay for 30 of the 60.
    world = small_world(battery_j=0.5)
    _, _, _, _, infos = step(world, (0, 0), (1, 0))
    assert infos["uav_0"]["collected"] == 30
    assert world.sensors.battery[0] == pytest.approx(0.0, abs=1e-9)
    observations, _, _, _, infos = step(world, (0, 0), (2, 0))
    assert (infos["uav_0"]["failed"], infos["uav_0"]["collected"]) == (True, 0)
    assert world.sensors.queue[0] == 30
    assert observations["uav_0"]["last_heard"][0] == 2, "a flat sensor's beacon is heard all the same"


def test_overflow_is_counted_in_events_and_packets_and_the_queue_clipped() -> None:
    world = small_world(arrivals=(5, 7, 9))
    step(world, (0, 0), (2, 0))
    assert world.sensors.queue.tolist() == [5, 60, 60]
    tally = world.tally[0]
    assert (tally.step, tally.failures, tally.overflows, tally.lost_packets, tally.events) == (0, 1, 2, 16, 3)


def test_a_queue_that_is_exactly_full_does_not_overflow() -> None:
    world = small_world(arrivals=(60, 1, 0))
    step(world, (0, 0), (1, 0))
    assert world.sensors.queue.tolist() == [60, 1, 60]
    assert world.tally[0].overflows == 0


def test_default_cost_charges_losses_within_reach() -> None:
    world = small_world(arrivals=(5, 7, 9))
    _, rewards, _, _, infos = step(world, (0, 0), (2, 0))
    # Sensor 2 overflows too, but at 400 m neither UAV could have served it.
    assert [infos[a]["lost_packets"] for a in world.agents] == [7, 7]
    assert [infos[a]["cost"] for a in world.agents] == pytest.approx([7 / 60, 1 + 7 / 60])
    assert rewards == {agent: -infos[agent]["cost"] for agent in world.agents}


def test_the_transfer_happens_at_the_new_position() -> None:
    scenario = Scenario(sensors=1, uavs=1, radio_radius_m=50.0, lap_radius_m=140 / np.pi, lap_offset_m=0.0)
    world = PipelineWorld(scenario)
    world.reset(seed=0)
    start = world.fleet.positions[0]
    world.sensors.positions[0] = start
    _, _, _, _, infos = step(world, (0, 14))
    # 140 m are half a lap: the UAV is now a diameter, 89 m, from the sensor.
    np.testing.assert_allclose(world.fleet.positions[0], 2 * np.array(world.scenario.lap_centres[0]) - start)
    assert infos["uav_0"]["failed"] is True
    _, _, _, _, infos = step(world, (0, 14))
    assert infos["uav_0"]["failed"] is False


# ---- a mission


def test_the_mission_is_truncated_at_the_last_step_and_not_before() -> None:
    world = small_world()
    for last in (False, False, False, True):
        observations, _, terminations, truncations, _ = step(world, (0, 0), (1, 0))
        assert set(truncations.values()) == {last}
        assert set(terminations.values()) == {False}
    assert observations["uav_0"]["step"].tolist() == [4]
    assert world.agents == []


def test_an_observation_has_the_last_beacon_heard() -> None:
    world = PipelineWorld()
    observations, _ = world.reset(seed=3)
    held = 0
    for now in range(30):
        before = observations
        observations, *_ = world.step(dict.fromkeys(world.agents, (now % 10, 14)))
        for uav in range(3):
            was, seen = before[f"uav_{uav}"], observations[f"uav_{uav}"]
            distance = np.hypot(*(world.sensors.positions - world.fleet.positions[uav]).T)
            heard = distance <= 360.0
            np.testing.assert_array_equal(seen["queue"], np.where(heard, world.sensors.queue, was["queue"]))
            np.testing.assert_array_equal(seen["battery"], np.where(heard, world.sensors.battery, was["battery"]))
            gain = channel_gain_db(distance, world.scenario)
            np.testing.assert_array_equal(seen["channel_gain"], np.where(heard, gain, was["channel_gain"]))
            np.testing.assert_array_equal(seen["last_heard"], np.where(heard, now + 1, was["last_heard"]))
            held += int(np.count_nonzero(~heard & (seen["last_heard"] >= 0) & (seen["queue"] != world.sensors.queue)))
    assert held > 0, "no UAV ever held an outdated state: the test has seen nothing"


def test_a_sensor_never_heard_shows_zeros() -> None:
    observations, _ = PipelineWorld(SMALL).reset(seed=0)
    seen = observations["uav_0"]
    assert seen["last_heard"].tolist() == [0, 0, -1]
    assert (seen["queue"][2], seen["battery"][2], seen["channel_gain"][2]) == (0.0, 0.0, 0.0)
    assert seen["queue"][:2].tolist() == [60.0, 60.0]


def test_a_caller_cannot_change_the_world_through_an_observation() -> None:
    touched, left = PipelineWorld(), PipelineWorld()
    observations, _ = touched.reset(seed=0)
    left.reset(seed=0)
    for name in ("queue", "battery", "channel_gain", "last_heard", "position", "sensor_position"):
        observations["uav_0"][name][:] = 7
    actions = dict.fromkeys(touched.agents, (0, 14))
    got, expected = touched.step(actions), left.step(actions)
    np.testing.assert_equal(got, expected)


# ---- random draws


def test_draws_are_within_the_scenarios_bounds() -> None:
    world = PipelineWorld(SCENARIOS["dense"])
    world.reset(seed=0)
    sensors = world.sensors
    assert np.all((sensors.positions >= 0) & (sensors.positions <= 1000))
    assert np.all((sensors.rates >= 2) & (sensors.rates <= 8))
    assert [sensors.initial_queue.min(), sensors.initial_queue.max()] == [18, 60]
    np.testing.assert_allclose(sensors.arrivals.mean(axis=0), sensors.rates, atol=5 * np.sqrt(8 / 30))


def test_initial_queues_are_bounded_from_above() -> None:
    world = PipelineWorld(Scenario(sensors=400, initial_queue_min=0.1, initial_queue_max=0.25))
    world.reset(seed=0)
    assert [world.sensors.initial_queue.min(), world.sensors.initial_queue.max()] == [6, 15]
    belief = FleetBelief(world.scenario)
    assert belief.base.mean() == pytest.approx(10.5)
    assert belief.base_variance.mean() == pytest.approx(9**2 / 12)


def test_pipeline_sensors_are_strung_along_the_line() -> None:
    line = ((0.0, 0.0), (400.0, 0.0), (400.0, 600.0))
    scenario = Scenario(layout="pipeline", pipeline=line, pipeline_spread_m=0.0, sensors=6)
    world = PipelineWorld(scenario)
    world.reset(seed=0)
    expected = [(0, 0), (200, 0), (400, 0), (400, 200), (400, 400), (400, 600)]
    np.testing.assert_allclose(world.sensors.positions, expected, atol=1e-9)

    jittered = PipelineWorld(scenario.model_copy(update={"pipeline_spread_m": 20.0}))
    jittered.reset(seed=0)
    offset = np.abs(jittered.sensors.positions - expected)
    assert 0 < offset.max() <= 20.0
    assert np.all(jittered.sensors.positions >= 0)


# ---- faults


@pytest.mark.parametrize(
    ("actions", "fault"),
    [
        ({"uav_0": (0, 0)}, "uav_1: no action"),
        ({"uav_0": (0, 0), "uav_1": (3, 0)}, "uav_1: sensor 3 is not in 0..2"),
        ({"uav_0": (-1, 0), "uav_1": (0, 0)}, "uav_0: sensor -1 is not in 0..2"),
        ({"uav_0": (0, 15), "uav_1": (0, 0)}, "uav_0: velocity 15 is not in 0..14"),
        ({"uav_0": (0, 1.5), "uav_1": (0, 0)}, "uav_0: action .* is not two integers"),
        ({"uav_0": 3, "uav_1": (0, 0)}, "uav_0: action 3 is not two integers"),
        ({"uav_0": (0, 0), "uav_1": (0, 0), "uav_7": (0, 0)}, "uav_7: no such agent"),
    ],
)
def test_a_bad_action_names_its_agent_and_changes_nothing(actions: Any, fault: str) -> None:
    world = small_world(arrivals=(5, 5, 5))
    queue, places = world.sensors.queue.copy(), world.fleet.positions.copy()
    with pytest.raises(ValueError, match=fault):
        world.step(actions)
    np.testing.assert_array_equal(world.sensors.queue, queue)
    np.testing.assert_array_equal(world.fleet.positions, places)
    assert world.tally == []


def test_stepping_a_world_that_does_not_run() -> None:
    with pytest.raises(ValueError, match="step before reset"):
        step(PipelineWorld(SMALL), (0, 0), (0, 0))
    world = small_world(steps=1)
    step(world, (0, 0), (1, 0))
    with pytest.raises(ValueError, match="after the mission's end"):
        step(world, (0, 0), (1, 0))
