"""Receding-horizon planning: what it believes, that it repeats, and that it beats what is simpler."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.scenario import SCENARIOS, Scenario
from simulator.policies import policy_named
from simulator.policies.mpc import FleetBelief, RecedingHorizon
from simulator.rollout import rollout
from simulator.world import Observation, PipelineWorld

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 10})
NONE: frozenset[int] = frozenset()


def beacons(queue: list[float], last_heard: list[int], now: int) -> Observation:
    count = len(queue)
    return Observation(
        step=np.array([now]),
        position=np.zeros(2),
        progress=np.zeros(1),
        sensor_position=np.zeros((count, 2)),
        queue=np.array(queue, dtype=np.float64),
        battery=np.full(count, 40.0),
        channel_gain=np.full(count, -80.0),
        last_heard=np.array(last_heard),
    )


def belief() -> FleetBelief:
    return FleetBelief(Scenario(name="two", sensors=2, uavs=2))


# ---- the fleet's belief


def test_a_sensor_never_heard_began_like_the_average_one() -> None:
    fleet = belief()
    np.testing.assert_allclose(fleet.queue(0), 39.0)
    np.testing.assert_allclose(fleet.queue(2), 49.0)
    assert (fleet.base_variance > 0).all()


def test_the_newest_beacon_wins_whoever_heard_it() -> None:
    fleet = belief()
    fleet.hear(beacons([10.0, 20.0], [4, 2], now=4))
    fleet.hear(beacons([55.0, 30.0], [1, 3], now=4))
    np.testing.assert_allclose(fleet.base, [10.0, 30.0])
    assert fleet.heard.tolist() == [4, 3]
    assert (fleet.base_variance == 0).all()


def test_a_queue_is_rolled_forward_until_it_is_full() -> None:
    fleet = belief()
    fleet.hear(beacons([10.0, 58.0], [0, 0], now=0))
    np.testing.assert_allclose(fleet.queue(3), [25.0, 60.0])


def test_the_rate_is_learned_from_successive_beacons() -> None:
    fleet = belief()
    for now in range(10):
        fleet.hear(beacons([8.0 * now % 60, 2.0 * now], [now, now], now=now))
    assert fleet.rate[0] > 6.5
    assert fleet.rate[1] < 3.0


def test_a_full_queue_says_nothing_of_the_rate() -> None:
    fleet = belief()
    fleet.hear(beacons([50.0, 50.0], [0, 0], now=0))
    fleet.hear(beacons([60.0, 55.0], [8, 8], now=8))
    assert fleet.rate[0] == pytest.approx(5.0)
    assert fleet.rate[1] < 5.0


def test_what_was_collected_is_subtracted_and_no_arrival() -> None:
    fleet = belief()
    fleet.hear(beacons([50.0, 50.0], [0, 0], now=0))
    fleet.collect(0, 60, step=0)
    assert fleet.queue(1)[0] == pytest.approx(5.0)
    fleet.hear(beacons([9.0, 50.0], [1, 0], now=1))
    assert fleet.rate[0] > 5.0


# ---- the policy


def flown(scenario: Scenario, seed: int) -> list[tuple[int, list[int]]]:
    return [(t.lost_packets, t.collected.tolist()) for t in rollout(PipelineWorld(scenario), RecedingHorizon(), seed)]


def test_the_same_seed_is_the_same_mission_to_the_bit() -> None:
    assert flown(SHORT, 100) == flown(SHORT, 100)


def test_a_policy_that_flew_before_flies_as_a_new_one() -> None:
    policy = RecedingHorizon()
    rollout(PipelineWorld(SHORT), policy, 101)
    again = [(t.lost_packets, t.collected.tolist()) for t in rollout(PipelineWorld(SHORT), policy, 100)]
    assert again == flown(SHORT, 100)


def test_it_loses_far_less_than_eof() -> None:
    world = PipelineWorld()
    lost = {name: sum(t.lost_packets for t in rollout(world, policy_named(name), 104)) for name in ("mpc", "eof")}
    assert lost["mpc"] < 0.5 * lost["eof"]


def test_what_it_is_not_told_does_not_move_it() -> None:
    """Two worlds that differ only in what nobody has observed yet: the decisions are the same until somebody has."""
    decisions = []
    for hidden in (0, 20):
        world, policy = PipelineWorld(SHORT), RecedingHorizon()
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
    world, policy = PipelineWorld(SHORT), RecedingHorizon()
    observations, _ = world.reset(seed=100)
    policy.reset(SHORT, 100)
    first, _ = policy.decide(1, observations["uav_1"], NONE)
    policy.reset(SHORT, 100)
    assert policy.decide(1, observations["uav_1"], frozenset({first}))[0] != first


def test_with_nothing_in_reach_it_still_answers() -> None:
    deaf = SHORT.model_copy(update={"radio_radius_m": 1.0})
    assert len(flown(deaf, 100)) == 10


def test_with_no_time_to_search_it_still_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.policies.mpc._MOST_WORK", 1e-9)
    assert len(flown(SHORT, 100)) == 10


def test_with_no_work_saved_it_searches_briefly_and_still_loses_less_than_eof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.policies.mpc._SAVED_WORK", 0.0)
    monkeypatch.setattr("simulator.policies.mpc._WORK", 1e-9)
    stress = SCENARIOS["stress"].model_copy(update={"steps": 12})
    eof = sum(t.lost_packets for t in rollout(PipelineWorld(stress), policy_named("eof"), 101))
    assert sum(lost for lost, _ in flown(stress, 101)) < eof


@pytest.mark.parametrize("changes", [{"sensors": 1, "uavs": 1, "steps": 1}, {"sensors": 1, "uavs": 3, "steps": 3}])
def test_the_smallest_fleets_fly(changes: Any) -> None:
    assert len(flown(SHORT.model_copy(update=changes), 0)) == changes["steps"]


def test_a_large_fleet_plans_uav_by_uav() -> None:
    crowd = SCENARIOS["dense"].model_copy(update={"steps": 3, "uavs": 6, "sensors": 60})
    assert sum(sum(collected) for _, collected in flown(crowd, 100)) > 6 * 30


def test_a_large_fleet_loses_less_than_half_of_eofs() -> None:
    dense = SCENARIOS["dense"].model_copy(update={"steps": 10})
    eof = sum(t.lost_packets for t in rollout(PipelineWorld(dense), policy_named("eof"), 100))
    assert sum(lost for lost, _ in flown(dense, 100)) < 0.5 * eof
