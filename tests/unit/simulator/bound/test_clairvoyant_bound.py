"""The clairvoyant bound, compared with an exhaustive search and with every policy."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from shared.world.channel import link_holds, packets_per_step
from shared.world.scenario import SCENARIOS, Scenario
from simulator.bound.clairvoyant_bound import clairvoyant, mission_bound, problem_of, replay
from simulator.errors import UsageError
from simulator.flying.flight import rollout
from simulator.policies.registry import POLICY_NAMES, policy_named
from simulator.sites.site import Site
from simulator.world.batch import Draw, VectorWorld, stacked
from simulator.world.gain_trace import GainTrace

ROUTES = (((100.0, 100.0), (900.0, 100.0)), ((100.0, 900.0), (900.0, 900.0), (500.0, 400.0)))
BUSY: dict[str, Any] = {"initial_queue_min": 0.8, "arrival_rate_min": 15.0, "arrival_rate_max": 25.0}


def small(**changes: Any) -> Site:
    """A small world with links of 3 to 60 packets a step, so that the position of a transfer matters."""
    defaults: dict[str, Any] = {"name": "small", "sensors": 3, "uavs": 2, "steps": 3, "max_velocity": 2}
    return Site(Scenario(**{**defaults, "step_s": 100.0, "packet_bits": 1.1e7, **BUSY, **changes}))


def least_by_trying(site: Site, seed: int) -> int:
    """The fewest packets lost over all flights, by a search of every joint action in every reachable state."""
    problem, world = problem_of(site, seed), site.scenario
    farthest = np.arange(world.steps * world.max_velocity + 1)
    distance = [problem.distance(uav, farthest) for uav in range(world.uavs)]
    links = [np.where(link_holds(d, world), packets_per_step(d, world), -1).tolist() for d in distance]
    actions = list(product(range(world.sensors), range(world.max_velocity + 1)))
    states = {((0,) * world.uavs, tuple(problem.queue.tolist())): 0}
    for arrivals in problem.arrivals.tolist():
        after: dict[Any, int] = {}
        for (flown, queue), lost in states.items():
            for joint in product(actions, repeat=world.uavs):
                now = tuple(f + v for f, (_, v) in zip(flown, joint, strict=True))
                left = collected(queue, [(j, links[u][now[u]][j]) for u, (j, _) in enumerate(joint)])
                filled = [q + a for q, a in zip(left, arrivals, strict=True)]
                state = now, tuple(min(q, world.queue_capacity) for q in filled)
                total = lost + sum(filled) - sum(state[1])
                after[state] = min(total, after.get(state, total))
        states = after
    return min(states.values())


def collected(queue: tuple[int, ...], transfers: list[tuple[int, int]]) -> list[int]:
    """The queues after transfers of (sensor, packets that the link can move, -1 for none)."""
    left, served = list(queue), set[int]()
    for sensor, packets in transfers:
        if packets >= 0 and sensor not in served:
            served.add(sensor)
            left[sensor] = max(0, left[sensor] - packets)
    return left


@pytest.mark.parametrize("seed", range(10))
def test_the_bound_equals_an_exhaustive_search(seed: int) -> None:
    site = small(sensors=2) if seed % 2 else small(steps=2)
    bound = clairvoyant(site, seed, workers=1)
    assert bound.lower_bound == bound.lost_packets == least_by_trying(site, seed)
    assert bound.optimal
    assert bound.gap == 0


def test_an_exhaustive_search_of_three_sensors_two_uavs_and_three_steps() -> None:
    bound = clairvoyant(small(), 1, workers=1)
    assert bound.lower_bound == bound.lost_packets == least_by_trying(small(), 1)


FEW_SENSORS = [small(steps=4, sensors=1, uavs=2), small(steps=4, sensors=2, uavs=3)]


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("site", FEW_SENSORS)
def test_with_fewer_sensors_than_uavs_the_bound_is_below_every_flight(site: Site, seed: int) -> None:
    bound = clairvoyant(site, seed, time_limit_s=5, workers=1)
    assert bound.lower_bound <= bound.lost_packets
    for name in POLICY_NAMES:
        lost = sum(tally.lost_packets for tally in rollout(site.world(), policy_named(name), seed))
        assert bound.lower_bound <= lost, name


# The proofs of the other scenarios take half a minute.
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("site", [small(steps=5), small(steps=5, routes=ROUTES), small(steps=5, battery_j=20.0)])
def test_no_policy_loses_less_than_the_bound(site: Site, seed: int) -> None:
    bound = clairvoyant(site, seed, workers=1)
    for name in POLICY_NAMES:
        lost = sum(tally.lost_packets for tally in rollout(site.world(), policy_named(name), seed))
        assert bound.lower_bound <= lost, name


@pytest.mark.long
def test_no_policy_learned_or_not_loses_less_than_the_bound_on_worlds_like_the_papers() -> None:
    site = Site(SCENARIOS["paper"].model_copy(update={"steps": 8, "initial_queue_min": 0.9}))
    bound = clairvoyant(site, 5, workers=1)
    for name in POLICY_NAMES:
        lost = sum(tally.lost_packets for tally in rollout(site.world(), policy_named(name), 5))
        assert bound.lower_bound <= lost, name


@pytest.mark.long
@pytest.mark.parametrize("name", ["paper", "pipeline"])
def test_the_plan_loses_in_the_world_as_many_packets_as_predicted(name: str) -> None:
    site = Site(SCENARIOS[name])
    bound = clairvoyant(site, 0, time_limit_s=30, workers=1)
    assert bound.optimal
    assert replay(site, 0, bound.actions) == bound.lost_packets
    assert bound.actions.shape == (30, 3, 2)


def test_flat_batteries_leave_a_bound_below_and_a_flight_that_is_true() -> None:
    site = small(steps=4, battery_j=6.0)
    bound = clairvoyant(site, 2, time_limit_s=5, workers=1)
    assert clairvoyant(small(steps=4), 2, workers=1).lower_bound <= bound.lower_bound <= bound.lost_packets
    assert replay(site, 2, bound.actions) == bound.lost_packets


def test_the_bound_knows_recorded_arrivals() -> None:
    scenario = small().scenario
    quiet = Site(scenario, arrivals=np.zeros((3, 3), dtype=np.int64))
    assert clairvoyant(quiet, 0, workers=1).lost_packets == 0
    flood = Site(scenario, arrivals=np.full((3, 3), 100, dtype=np.int64))
    assert clairvoyant(flood, 0, workers=1).lower_bound >= 3 * 3 * 40


def least_by_flying(site: Site, seed: int) -> int:
    """The fewest packets lost over all flights, each flown in a world of its own, all at once."""
    world = site.scenario
    one = list(product(range(world.sensors), range(world.max_velocity + 1)))
    joint = list(product(one, repeat=world.uavs))
    flights = np.array(list(product(joint, repeat=world.steps)))
    batch = VectorWorld(world)
    batch.start(stacked([Draw.one(world, np.random.SeedSequence(seed))] * len(flights)))
    lost = [batch.fly(flights[:, step, :, 0], flights[:, step, :, 1])[1].lost_packets for step in range(world.steps)]
    return int(np.sum(lost, axis=0).min())


DIFFERING: dict[str, dict[str, Any]] = {
    "shadowed": {"shadowing_db": 25.0, "route_shadowing_db": 25.0},
    "fading": {"rician_k_db": -5.0},
    "bursty": {"burst_factor": 10.0},
    "dead": {"dead_radios": 2},
    "departed": {"departures": 1},
    "weaker": {"link_share_drop": 0.7},
}


@pytest.mark.parametrize("seed", [4, 6])
@pytest.mark.parametrize("name", DIFFERING)
def test_the_bound_knows_the_true_world(name: str, seed: int) -> None:
    site = small(sensors=2, steps=2, **DIFFERING[name])
    bound = clairvoyant(site, seed, time_limit_s=10, workers=1)
    assert bound.lower_bound == bound.lost_packets == least_by_flying(site, seed)


def test_a_world_with_wind_has_no_bound() -> None:
    site = small(gust_mps=0.5)
    with pytest.raises(UsageError, match="scenario small has wind"):
        clairvoyant(site, 0, workers=1)
    assert mission_bound(site, 0, site.scenario.steps, 1.0) == "in wind no plan is flown as made"


def test_the_bound_knows_recorded_gains() -> None:
    scenario = small().scenario
    pairs = product(range(scenario.uavs), range(scenario.sensors))
    silent = GainTrace({pair: (np.zeros(1), np.full(1, 150.0)) for pair in pairs})
    site = Site(scenario, gains=silent)
    idle = np.zeros((scenario.steps, scenario.uavs, 2), dtype=np.int64)
    bound = clairvoyant(site, 0, workers=1)
    assert bound.lower_bound == bound.lost_packets == replay(site, 0, idle)


def test_a_plan_that_the_world_does_not_confirm_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.bound.clairvoyant_bound.replay", lambda site, seed, actions: -1)
    for site in (small(), small(shadowing_db=4.0)):
        with pytest.raises(RuntimeError, match="the plan of seed 3 loses"):
            clairvoyant(site, 3, workers=1)


@pytest.mark.parametrize(("sensors", "uavs", "steps"), [(1, 1, 1), (1, 2, 2), (4, 1, 1)])
def test_the_smallest_worlds(sensors: int, uavs: int, steps: int) -> None:
    site = small(sensors=sensors, uavs=uavs, steps=steps)
    bound = clairvoyant(site, 0, time_limit_s=5, workers=1)
    assert bound.lower_bound <= least_by_trying(site, 0) <= bound.lost_packets
