"""Plans that wait for others, or are searched while the mission goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from service.config.settings import Settings
from service.mission.mission import Mission
from service.mission.planner import MissionPlanner
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance, SensorWish
from shared.wire.schemas import MissionSpec
from tests.support.missions import uav
from tests.support.waiting import Gate


def reported() -> tuple[Mission, MissionPlanner]:
    """A mission of which UAV 0 has reported."""
    mission = Mission("test", MissionSpec(), Settings(mode="policy"))
    x, y = (float(metres) for metres in mission.belief.trajectory(0).at(0.0))
    mission.observe(uav(position=(x, y), x=[x, x + 20.0], queue=[55.0, 55.0]), 0)
    assert mission.planner is not None
    return mission, mission.planner


@contextmanager
def busy() -> Iterator[tuple[ThreadPoolExecutor, Gate]]:
    """A thread for searches that is busy until the gate opens."""
    with ThreadPoolExecutor(1) as pool, Gate() as gate:
        pool.submit(gate.wait)
        yield pool, gate


def test_a_plan_by_orders_that_have_changed_meanwhile_is_dropped() -> None:
    mission, planner = reported()

    async def ordered_meanwhile() -> None:
        with busy() as (pool, gate):
            search = asyncio.create_task(planner.plan([0], (), 1.0, pool))
            await asyncio.sleep(0)
            ordered = Guidance(min_velocity=5, sensors=[SensorWish(sensor_id=0, weight=0.0)])
            mission.answer_guidance(GuidanceAnswer(guidance=ordered))
            gate.open()
            await search

    asyncio.run(ordered_meanwhile())
    assert planner.plans == {}


def test_a_plan_that_waits_until_its_step_is_over_is_not_searched() -> None:
    mission, planner = reported()
    x, y = (float(metres) for metres in mission.belief.trajectory(0).at(0.0))

    async def over() -> None:
        with busy() as (pool, gate):
            plans = [asyncio.create_task(planner.plan([0], (), 1.0, pool)) for _ in range(3)]
            await asyncio.sleep(0)
            mission.observe(uav(position=(x, y), x=[x, x + 20.0], queue=[55.0, 55.0]), 1)
            gate.open()
            await asyncio.gather(*plans)

    searches, copy = 0, planner.copy

    def counted() -> MissionPlanner:
        nonlocal searches
        searches += 1
        return copy()

    planner.copy = counted  # type: ignore[method-assign]
    asyncio.run(over())
    assert searches == 1
