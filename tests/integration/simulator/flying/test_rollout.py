"""Whole missions: the arguments of policies, the draws of a seed, and invariants under any actions."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.client.edge_client import EdgeClient
from shared.world.channel import link_holds
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.edge_session import LossyTransport
from simulator.flying.flight import fly, rollout
from simulator.flying.pilots import EdgePilot, LocalPilot
from simulator.policies.registry import POLICY_NAMES, policy_named
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation
from tests.support.edge_stub import stub_edge


class Recorder:
    """Takes sensor ``uav`` every time, and records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int, frozenset[int], tuple[float, float]]] = []
        self.resets: list[tuple[Scenario, int]] = []

    def reset(self, scenario: Scenario, seed: int) -> None:
        self.resets.append((scenario, seed))

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        x, y = observation["position"].tolist()
        self.calls.append((int(observation["step"][0]), uav, taken, (x, y)))
        return uav, 4


def test_uavs_decide_in_order_and_later_ones_get_the_taken_sensors() -> None:
    recorder, world = Recorder(), PipelineWorld()
    rollout(world, recorder, seed=9)
    assert recorder.resets == [(SCENARIOS["paper"], 9)]
    order = [(step, uav) for step, uav, _, _ in recorder.calls]
    assert order == [(step, uav) for step in range(30) for uav in range(3)]
    assert [taken for _, _, taken, _ in recorder.calls[:3]] == [frozenset(), frozenset({0}), frozenset({0, 1})]
    assert recorder.calls[3][2] == frozenset(), "reservations last one step"


def test_each_uav_sees_its_own_position() -> None:
    recorder, world = Recorder(), PipelineWorld()
    observations, _ = world.reset(seed=9)
    rollout(world, recorder, seed=9)
    assert [p for *_, p in recorder.calls[:3]] == [tuple(o["position"].tolist()) for o in observations.values()]


def test_every_step_is_returned() -> None:
    world = PipelineWorld()
    tally = rollout(world, policy_named("eof"), seed=1)
    assert tally == world.tally
    assert len(tally) == 30


def test_the_same_seed_flies_the_same_mission() -> None:
    def flown(seed: int) -> list[tuple[int, int, list[int]]]:
        tally = rollout(PipelineWorld(), policy_named("random"), seed)
        return [(t.events, t.lost_packets, t.collected.tolist()) for t in tally]

    assert flown(3) == flown(3)
    assert flown(3) != flown(4)


# ---- seeds


def drawn(world: PipelineWorld) -> list[bytes]:
    s = world.sensors
    return [a.tobytes() for a in (s.positions, s.rates, s.initial_queue, s.arrivals, world.fleet.start_m)]


def test_no_policy_changes_the_world() -> None:
    worlds = set()
    for name in POLICY_NAMES:
        world = PipelineWorld(SCENARIOS["paper"].model_copy(update={"steps": 8}))
        rollout(world, policy_named(name), seed=5)
        worlds.add(tuple(drawn(world)))
    assert len(worlds) == 1


class Reckless:
    """Draws from every global generator, and seeds it again."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        self._count = scenario.sensors
        random.seed(seed)
        np.random.seed(seed)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        np.random.seed(int(np.random.randint(2**31)))
        return random.randrange(self._count), int(np.random.randint(15))


@dataclass(frozen=True, eq=False)
class Watched(Site):
    """A site that stores the worlds made on it."""

    made: list[PipelineWorld] = field(default_factory=list)

    def world(self) -> PipelineWorld:
        self.made.append(super().world())
        return self.made[-1]


ROUTES = Scenario(
    name="routes",
    layout="surveyed",
    steps=4,
    sites=tuple((100.0 * j, 50.0 * (j % 3)) for j in range(10)),
    routes=(
        ((0.0, 0.0), (900.0, 0.0)),
        ((0.0, 500.0), (900.0, 500.0), (900.0, 0.0), (0.0, 500.0)),
        ((900.0, 0.0), (500.0, 100.0), (100.0, 0.0)),
    ),
)
TRACE = np.arange(50).reshape(5, 10)
SITES = {
    "paper": Site(SCENARIOS["paper"].model_copy(update={"steps": 4})),
    "lossy": Site(SCENARIOS["lossy_uplink"].model_copy(update={"steps": 4, "uplink_jitter_ms": 1.0})),
    "routes": Site(ROUTES),
    "traced": Site(ROUTES, TRACE),
}


@pytest.mark.parametrize("site", SITES)
def test_the_world_is_the_same_for_every_pilot(site: str) -> None:
    """Every policy, the edge over a reliable or a lossy uplink, no edge, and a policy with global generators."""
    watched = Watched(SITES[site].scenario, SITES[site].arrivals)
    scenario = watched.scenario
    for name in POLICY_NAMES:
        fly(watched, LocalPilot(name, scenario, 5), seed=5)
    rollout(watched.world(), Reckless(), seed=5)
    with stub_edge() as stub:
        for behaviour, transport in (
            ("ok", None),
            ("garbage", None),
            ("ok", LossyTransport(httpx.HTTPTransport(), drop=0.3, jitter_ms=1.0, seed=5)),
        ):
            stub.otherwise = behaviour  # type: ignore[assignment]
            with EdgeClient(stub.url, timeout_s=60, attempts=1, seed=5, transport=transport) as client:
                fly(watched, EdgePilot(client, "m", scenario, seed=5), seed=5)
    assert len({tuple(drawn(world)) for world in watched.made}) == 1
    assert len(watched.made) == len(POLICY_NAMES) + 4
    assert all(len(world.tally) == scenario.steps for world in watched.made)


def test_a_trace_replaces_only_the_arrivals() -> None:
    drawn_world, traced = SITES["routes"].world(), SITES["traced"].world()
    drawn_world.reset(seed=5)
    traced.reset(seed=5)
    np.testing.assert_array_equal(traced.sensors.arrivals, TRACE[:4])
    before, after = drawn(drawn_world), drawn(traced)
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, True, True, False, True]


def test_another_seed_is_another_world_in_everything() -> None:
    world = PipelineWorld()
    world.reset(seed=1)
    first = drawn(world)
    world.reset(seed=2)
    assert all(a != b for a, b in zip(first, drawn(world), strict=True))


def test_a_reset_without_a_seed_goes_on_reproducibly_to_another_world() -> None:
    one, two = PipelineWorld(), PipelineWorld()
    seen = []
    for world in (one, two):
        world.reset(seed=1)
        first = drawn(world)
        world.reset()
        seen.append((first, drawn(world)))
    assert seen[0] == seen[1]
    assert seen[0][0] != seen[0][1]


def test_each_kind_of_draw_has_a_child_of_the_seed_to_itself() -> None:
    world = PipelineWorld()
    world.reset(seed=7)
    layout, rates, queues, angles, arrivals = map(np.random.default_rng, np.random.SeedSequence(7).spawn(5))
    sensors = world.sensors
    np.testing.assert_array_equal(sensors.positions, layout.uniform(0.0, 1000.0, (10, 2)))
    np.testing.assert_array_equal(sensors.rates, rates.uniform(2.0, 8.0, 10))
    np.testing.assert_array_equal(sensors.initial_queue, queues.integers(18, 61, 10))
    np.testing.assert_allclose(world.fleet.start_m, angles.uniform(0.0, 1.0, 3) * 600 * np.pi)
    np.testing.assert_array_equal(sensors.arrivals, arrivals.poisson(sensors.rates, (30, 10)))


def test_a_longer_mission_begins_like_the_shorter_one() -> None:
    short, long = PipelineWorld(), PipelineWorld(SCENARIOS["paper"].model_copy(update={"steps": 60}))
    short.reset(seed=1)
    long.reset(seed=1)
    np.testing.assert_array_equal(long.sensors.arrivals[:30], short.sensors.arrivals)
    np.testing.assert_array_equal(long.sensors.positions, short.sensors.positions)


# ---- invariants under any actions


@settings(max_examples=25, deadline=None)
@given(
    name=st.sampled_from(["paper", "pipeline", "stress"]),
    seed=st.integers(0, 2**32 - 1),
    battery=st.sampled_from([0.01, 0.7, 50.0]),
    flown=st.randoms(use_true_random=False),
)
def test_no_packet_appears_or_vanishes(name: str, seed: int, battery: float, flown: Any) -> None:
    world = PipelineWorld(SCENARIOS[name].model_copy(update={"battery_j": battery}))
    world.reset(seed=seed)
    lost, arrived, paid = np.zeros((3, 10), dtype=np.int64)
    while world.agents:
        before, now = world.sensors.queue.copy(), len(world.tally)
        actions = {a: (flown.randrange(10), flown.randrange(15)) for a in world.agents}
        _, _, _, _, infos = world.step(actions)
        tally, arrivals = world.tally[-1], world.sensors.arrivals[now]
        spilt = np.maximum(before - tally.collected + arrivals - 60, 0)
        assert [tally.lost_packets, tally.overflows] == [int(spilt.sum()), int(np.count_nonzero(spilt))]
        assert sum(i["collected"] for i in infos.values()) == tally.collected.sum()
        assert sum(i["failed"] for i in infos.values()) == tally.failures
        lost += spilt
        arrived += arrivals
        paid += tally.collected
    np.testing.assert_array_equal(world.sensors.initial_queue + arrived, world.sensors.queue + paid + lost)
    assert np.all((world.sensors.queue >= 0) & (world.sensors.queue <= 60))
    assert np.all((world.sensors.battery >= 0) & (world.sensors.battery <= battery))


def test_losses_are_blamed_on_uavs_with_a_usable_link() -> None:
    world = PipelineWorld(SCENARIOS["stress"])
    world.reset(seed=4)
    while world.agents:
        before, now = world.sensors.queue.copy(), len(world.tally)
        _, _, _, _, infos = world.step(dict.fromkeys(world.agents, (0, 3)))
        spilt = np.maximum(before - world.tally[-1].collected + world.sensors.arrivals[now] - 60, 0)
        for uav, info in enumerate(infos.values()):
            distance = np.hypot(*(world.sensors.positions - world.fleet.positions[uav]).T)
            assert info["lost_packets"] == spilt[link_holds(distance, world.scenario)].sum()
    assert sum(t.lost_packets for t in world.tally) > 0


def test_a_policys_whole_floats_are_whole_numbers_and_others_an_error() -> None:
    class Floats:
        velocity = 7.0

        def reset(self, scenario: Scenario, seed: int) -> None: ...

        def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
            return uav, self.velocity  # type: ignore[return-value]

    policy = Floats()
    assert len(rollout(PipelineWorld(SCENARIOS["paper"].model_copy(update={"steps": 2})), policy, 0)) == 2
    policy.velocity = 7.5
    with pytest.raises(ValueError, match="not two whole numbers"):
        rollout(PipelineWorld(SCENARIOS["paper"]), policy, 0)
