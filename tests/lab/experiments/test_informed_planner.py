"""The planner that is told the true links: its twin is the world, and its links are the world's."""

from __future__ import annotations

import numpy as np
import pytest

from lab.experiments.informed_planner import InformedPilot, InformedPlanner
from shared.world.scenario import SCENARIOS
from simulator.flying.flight import fly
from simulator.flying.pilots import LocalPilot
from simulator.records.flight import Flight
from simulator.sites.site import Site

pytestmark = pytest.mark.usefixtures("brief")
NONE: frozenset[int] = frozenset()
WORLDS = ["shadowed", "fading", "windy", "faulty", "field"]


def site_of(name: str, steps: int = 5) -> Site:
    return Site(SCENARIOS[name].model_copy(update={"steps": steps}))


@pytest.mark.parametrize("name", WORLDS)
def test_the_twin_is_in_the_state_of_the_world(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    site = site_of(name)
    pilot = InformedPilot(site, 2)
    twin, decide, seen = pilot._twin, InformedPlanner.decide, []

    def watched(
        planner: InformedPlanner, uav: int, observation: dict[str, np.ndarray], taken: frozenset[int]
    ) -> object:
        seen.append(len(twin.tally) == int(observation["step"][0]))
        np.testing.assert_array_equal(observation["progress"], twin.fleet.progress_m[uav])
        return decide(planner, uav, observation, taken)  # type: ignore[arg-type]

    monkeypatch.setattr(InformedPlanner, "decide", watched)
    flight = fly(site, pilot, 2)
    assert len(seen) == len(flight.decisions) and all(seen)
    assert [t.lost_packets for t in twin.tally] == [t.lost_packets for t in flight.tally[:-1]]


@pytest.mark.parametrize("name", ["shadowed", "fading", "faulty"])
def test_the_links_of_its_problem_move_what_the_world_moves(name: str) -> None:
    site = site_of(name)
    world = site.world()
    observations, _ = world.reset(seed=4)
    planner = InformedPlanner(world)
    planner.reset(site.scenario, 4)
    planner.decide(0, observations["uav_0"], NONE)
    draft = planner.draft(0, NONE)
    assert draft is not None and draft.problem.links is not None and draft.problem.chances is None
    reported = draft.problem.links[draft.uavs.index(0)][0]
    moved = []
    for sensor in draft.kept.tolist():
        world.reset(seed=4)
        world.sensors.queue[:] = 60
        idle = (sensor, 0)
        *_, infos = world.step({"uav_0": (sensor, 9), "uav_1": idle, "uav_2": idle})
        moved.append(infos["uav_0"]["collected"])
    assert moved == [min(60, packets) for packets in reported[9, :-1].tolist()]
    assert sum(moved) > 0


def test_in_a_world_as_modelled_it_is_mpc() -> None:
    site = site_of("paper", 3)

    def decisions(flight: Flight) -> list[tuple[int, int]]:
        return [(d.sensor_id, d.velocity) for d in flight.decisions]

    reported, own = fly(site, InformedPilot(site, 1), 1), fly(site, LocalPilot("mpc", site.scenario, 1), 1)
    assert decisions(reported) == decisions(own)
