"""Limits of the LLM-free policy: an airframe's top speed, other UAVs' sensors, and the planner's share of the time."""

from __future__ import annotations

from collections.abc import Callable, Collection
from concurrent.futures import Executor
from typing import Any

import httpx
import pytest

from service.mission.planner import MissionPlanner
from shared.world.step_rule import Action
from tests.support.asking import PATHS, decide

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


@pytest.mark.parametrize(("slowest", "flown"), [(0, range(10)), (9, {9}), (12, range(12, 15))])
def test_a_top_speed_limits_the_velocity_where_the_orders_allow_it(
    edge: Edge, report: Report, slowest: int, flown: Collection[int]
) -> None:
    client = edge(mode="policy", planner="off")
    client.put("/missions/test", json={}).raise_for_status()
    orders = {"guidance": {"min_velocity": slowest}}
    client.post("/missions/test/guidance", json=orders).raise_for_status()
    for step in range(2):
        [answer] = decide(client, "/decide", report(step=step, top_speed_mps=9.0))
        assert answer["velocity"] in flown


def test_where_the_top_speed_is_forbidden_the_next_lower_velocity_is_flown(edge: Edge, report: Report) -> None:
    client = edge(mode="policy", planner="off")
    client.put("/missions/test", json={}).raise_for_status()
    orders = {"guidance": {"forbidden_velocities": [8, 9], "min_velocity": 7}}
    client.post("/missions/test/guidance", json=orders).raise_for_status()
    [answer] = decide(client, "/decide", report(top_speed_mps=9.0))
    assert answer["velocity"] == 7


@pytest.mark.parametrize("path", PATHS)
def test_where_every_reported_sensor_is_reserved_another_one_is_tried(edge: Edge, report: Report, path: str) -> None:
    client = edge(mode="policy", planner="off")
    client.put("/missions/test", json={}).raise_for_status()
    sensors = {
        name: column[1:2] if isinstance(column, list) else column for name, column in report()["sensors"].items()
    }
    answers = decide(client, path, *(report(uav_id=uav, sensors=sensors) for uav in range(3)))
    assert [answer["sensor_id"] for answer in answers] == [1, 0, 2]


@pytest.mark.parametrize("path", PATHS)
def test_in_mode_guided_the_plan_leaves_the_llm_half_of_the_time(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    given_s = list[float]()

    async def noted(
        self: MissionPlanner, uavs: Collection[int], reserved: Collection[int], seconds: float, executor: Executor
    ) -> None:
        given_s.append(seconds)

    monkeypatch.setattr(MissionPlanner, "plan", noted)
    for mode, limit_s in (("guided", 30.0), ("policy", 60.0)):
        client = edge(mode=mode, llm_gguf="none", planner_ms=60_000, deadline_ms=60_000)
        client.put("/missions/test", json={}).raise_for_status()
        given_s.clear()
        decide(client, path, report())
        assert len(given_s) == 1 and given_s[0] <= limit_s


@pytest.mark.parametrize("path", PATHS)
def test_a_planned_sensor_that_another_uav_has_reserved_is_not_flown_to(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    def planned(self: MissionPlanner, uav: int, reserved: Collection[int] = ()) -> Action | None:
        return None if 3 in reserved else Action(3, 5)

    monkeypatch.setattr(MissionPlanner, "action", planned)
    client = edge(mode="policy")
    client.put("/missions/test", json={}).raise_for_status()
    first, *others = decide(client, path, *(report(uav_id=uav) for uav in range(3)))
    assert (first["sensor_id"], first["velocity"]) == (3, 5)
    assert len({3, *(answer["sensor_id"] for answer in others)}) == 3
