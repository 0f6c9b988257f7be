"""The uplinks' encoders with a real edge: the parts sent, and full reports where the edge lacks the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest

from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeRefused
from shared.client.report_encoders import DeltaReports
from shared.wire.schemas import DecideRequest, MissionSpec
from shared.world.scenario import SCENARIOS
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request
from tests.integration.shared.client.test_edge_client import Awaited

Edge = Callable[..., httpx.Client]
PAPER = SCENARIOS["paper"]


@pytest.fixture(scope="module")
def steps() -> list[list[DecideRequest]]:
    """The observations of three UAVs at four steps."""
    world = PipelineWorld(PAPER)
    observations, _ = world.reset(seed=0)
    seen = []
    for step in range(4):
        seen.append([decide_request(uav, observations[f"uav_{uav}"], "m") for uav in range(3)])
        observations, *_ = world.step({f"uav_{uav}": [(step + uav) % 10, 9] for uav in range(3)})
    return seen


@pytest.fixture(params=[EdgeClient, Awaited])
def client(request: pytest.FixtureRequest) -> Callable[..., EdgeClient]:
    made: Callable[..., EdgeClient] = request.param
    return made


def test_a_first_report_is_full(
    edge: Edge, client: Callable[..., EdgeClient], steps: list[list[DecideRequest]]
) -> None:
    with client(str(edge().base_url), uplink="delta") as uavs:
        uavs.put_mission("m", MissionSpec())
        sizes = [[uavs.decide(request).request_bytes for request in requests] for requests in steps]
    assert min(sizes[0]) > 600 > max(size for later in sizes[1:] for size in later)


def test_an_edge_that_forgot_gets_full_reports(
    edge: Edge, client: Callable[..., EdgeClient], steps: list[list[DecideRequest]]
) -> None:
    http = edge()
    with client(str(http.base_url), uplink="delta") as uavs:
        uavs.put_mission("m", MissionSpec())
        uavs.decide(steps[0][0])
        http.delete("/missions/m").raise_for_status()
        uavs.put_mission("m", MissionSpec())
        again = uavs.decide(steps[1][0])
        assert (again.attempts, again.response.step) == (2, 1) and again.request_bytes > 1000
        assert uavs.decide(steps[2][0]).request_bytes < 600


def test_another_refusal_is_not_retried(edge: Edge, steps: list[list[DecideRequest]]) -> None:
    with EdgeClient(str(edge().base_url), uplink="delta") as uavs:
        uavs.put_mission("m", MissionSpec())
        uavs.decide(steps[0][0])
        with pytest.raises(EdgeRefused, match="unknown") as refused:
            uavs.decide(steps[1][0].model_copy(update={"uav_id": 9}))
        assert refused.value.type == "about:blank" and refused.value.status == 422


@pytest.mark.parametrize(
    "change",
    [{"mission_id": "other"}, {"uav_id": 2}, {"step": 0}, {"x": 1.0}, {"id": 9}],
    ids=["mission", "uav", "earlier", "place", "sensors"],
)
def test_a_delta_refers_only_to_the_last_answered_report(
    change: dict[str, Any], edge: Edge, steps: list[list[DecideRequest]]
) -> None:
    reports = DeltaReports()
    with EdgeClient(str(edge().base_url)) as uavs:
        uavs.put_mission("m", MissionSpec())
        reports.record_answer(steps[1][0], uavs.decide(steps[1][0]).response)
    now = steps[2][0]
    assert reports.encode("m", 2, now).base is not None
    mission_id, step = change.get("mission_id", "m"), change.get("step", 2)
    if "uav_id" in change:
        now = steps[2][change["uav_id"]]
    for column in {"x", "id"} & change.keys():
        rows = now.sensors.model_dump()
        rows = {name: values[:9] for name, values in rows.items()} if column == "id" else {**rows, "x": [1.0] * 10}
        now = now.model_copy(update={"sensors": type(now.sensors).model_validate(rows)})
    reduced = reports.encode(mission_id, step, now)
    assert reduced.base is None and reduced.uplink == "delta" and reduced.sensors == now.sensors
