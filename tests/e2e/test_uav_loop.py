"""examples/uav_loop: the loop of a real UAV, against a real edge; the vehicle alone is a stub."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from examples.uav_loop.__main__ import ORIGIN, world
from examples.uav_loop.loop import Flown, Leg, Loop
from examples.uav_loop.stub import StubPosition, StubWorld
from examples.uav_loop.vehicle import LocalFrame, yaw_deg
from shared.trajectory import trajectories
from simulator.client import AsyncEdgeClient, EdgeClient
from tests.conftest import Edge
from tests.e2e.processes import serving_edge
from tests.simulator.edge_stub import free_port

STEPS = 12
# The machine may be busy; what a slow edge brings is not asked here.
PATIENCE_S = 60.0


class Headwind(StubWorld):
    """Flies at half of the velocity that it is told."""

    async def set_current_speed(self, speed_m_s: float) -> None:
        await super().set_current_speed(speed_m_s / 2)


def stub(kind: type[StubWorld] = StubWorld, charge: float = 100.0) -> StubWorld:
    x, y = trajectories(world(STEPS))[0].at(0.0).tolist()
    return kind(world(STEPS), LocalFrame(*ORIGIN), (x, y), seed=0, charge=charge)


def loop(vehicle: StubWorld, edge: AsyncEdgeClient, on_leg: Callable[[Leg], None] = lambda leg: None) -> Loop:
    frame = LocalFrame(*ORIGIN)
    return Loop(vehicle.vehicle(), edge, world(STEPS), frame, "loop", patience_s=PATIENCE_S, on_leg=on_leg)


def gap_to_route(leg: Leg) -> float:
    return trajectories(world(STEPS))[0].locate(leg.position)[1]


async def test_the_edge_decides_every_step_and_hears_every_outcome(edge: Edge) -> None:
    async with AsyncEdgeClient(str(edge(mode="policy").base_url), timeout_s=PATIENCE_S) as client:
        flown = await loop(stub(), client).fly()
        status = await client.mission("loop")
    assert [leg.decided_by for leg in flown.legs] == ["policy"] * STEPS
    assert (status.decisions, status.feedback, flown.outcomes_told) == (STEPS, STEPS, STEPS)
    assert sum(leg.packets for leg in flown.legs) > 0
    for leg, after in zip(flown.legs, flown.legs[1:], strict=False):
        assert gap_to_route(leg) < 1
        # A step may cut one corner of the route.
        assert 0.7 * 10 * leg.velocity - 1 <= math.dist(leg.position, after.position) <= 10 * leg.velocity + 1


@pytest.mark.long
async def test_the_uav_flies_on_when_the_edge_dies() -> None:
    with serving_edge(AICVDS_MODE="policy", AICVDS_STORE="none") as (url, process):

        def kill(leg: Leg) -> None:
            if leg.step == 4:
                process.kill()

        async with AsyncEdgeClient(url, timeout_s=PATIENCE_S, attempts=2) as edge:
            flown = await loop(stub(), edge, on_leg=kill).fly()
    assert [leg.decided_by for leg in flown.legs] == ["policy"] * 5 + ["onboard"] * (STEPS - 5)
    assert flown.outcomes_told == 4
    assert flown.last_error is not None and url in flown.last_error
    assert sum(leg.packets for leg in flown.legs[5:]) > 0


async def test_an_edge_that_forgot_the_mission_decides_on(edge: Edge) -> None:
    url = str(edge(mode="policy").base_url)
    with EdgeClient(url, timeout_s=PATIENCE_S) as operator:

        def forget(leg: Leg) -> None:
            if leg.step == 4:
                operator.delete_mission("loop")

        async with AsyncEdgeClient(url, timeout_s=PATIENCE_S) as client:
            flown = await loop(stub(), client, on_leg=forget).fly()
        status = operator.mission("loop")
    assert [leg.decided_by for leg in flown.legs] == ["policy"] * STEPS
    assert status.scenario == world(STEPS)
    # The fifth decision's outcome was lost with it.
    assert status.decisions == status.feedback == STEPS - 5
    assert flown.outcomes_told == STEPS - 1


async def without_an_edge(vehicle: StubWorld) -> Flown:
    async with AsyncEdgeClient(f"http://127.0.0.1:{free_port()}", attempts=1) as nobody:
        return await loop(vehicle, nobody).fly()


async def test_against_the_wind_it_stays_on_its_trajectory() -> None:
    flown = await without_an_edge(stub(Headwind))
    assert len(flown.legs) == STEPS
    # At a corner it is sent across it; were it thought to be where it was sent, it would be led ever farther off.
    assert max(gap_to_route(leg) for leg in flown.legs) < 35
    for leg, after in zip(flown.legs, flown.legs[1:], strict=False):
        assert math.dist(leg.position, after.position) <= 5 * leg.velocity + 1


async def test_it_goes_home_on_a_low_battery() -> None:
    vehicle = stub(charge=23.0)
    flown = await without_an_edge(vehicle)
    assert flown.went_home and vehicle.sent_home
    assert 0 < len(flown.legs) < STEPS


def test_degrees_and_metres() -> None:
    frame = LocalFrame(*ORIGIN)
    assert frame.degrees(0.0, 0.0) == pytest.approx(ORIGIN)
    latitude, longitude = frame.degrees(0.0, 1000.0)
    assert latitude > ORIGIN[0] and longitude == pytest.approx(ORIGIN[1])
    assert frame.metres(StubPosition(*frame.degrees(640.0, 560.0), 0.0, 0.0)) == pytest.approx((640.0, 560.0))
    assert [yaw_deg((0, 0), to) for to in ((0, 1), (1, 0), (0, -1), (-1, 0))] == [0, 90, 180, 270]
