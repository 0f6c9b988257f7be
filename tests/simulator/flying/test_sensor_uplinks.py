"""Sensors that report themselves: which, when, what, and what the edge makes of it."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import numpy as np
import pytest

from shared.readings import ReadingsRequest, ReadingsResponse
from shared.scenario import scenario_named
from shared.wire import MissionSpec
from simulator.client import EdgeClient
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot
from simulator.flying.sensor_uplinks import SensorUplinks, UplinkPlan
from simulator.sites.site import Site
from simulator.world.sensors import Sensors

Edge = Callable[..., httpx.Client]
SCENARIO = scenario_named("paper").model_copy(update={"steps": 6})


def test_half_of_the_sensors_report_every_third_step(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    http = edge(planner="off")
    sent: list[tuple[int, int, float]] = []
    queues: dict[int, list[float]] = {}
    with EdgeClient(str(http.base_url)) as client:
        pilot = EdgePilot(client, "test", SCENARIO, 4)
        pilot.spec = MissionSpec(scenario=SCENARIO, mode="policy")
        client.put_mission("test", pilot.spec)
        uplinks = SensorUplinks(client, "test", SCENARIO, 4, UplinkPlan(share=0.5, every=3))
        read = client.read

        def noted(mission_id: str, request: ReadingsRequest) -> ReadingsResponse:
            sent.extend((r.step or 0, r.sensor_id, r.queue) for r in request.readings)
            return read(mission_id, request)

        monkeypatch.setattr(client, "read", noted)

        def decided(step: int, sensors: Sensors) -> None:
            queues[step] = sensors.queue.tolist()
            uplinks.send(step, sensors)

        fly(Site(SCENARIO), pilot, 4, on_decided=decided)
    sensors = {sensor for _, sensor, _ in sent}
    assert len(sensors) == SCENARIO.sensors // 2
    for sensor in sensors:
        steps = [step for step, other, _ in sent if other == sensor]
        assert len(steps) == 2 and np.diff(steps).tolist() == [3]
    assert all(queues[step][sensor] == queue for step, sensor, queue in sent)
    # Of those that no UAV heard in the same step, the edge learns something.
    status = http.get("/missions/test").json()
    assert 0 < status["readings"] <= len(sent)
