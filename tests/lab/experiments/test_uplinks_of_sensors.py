"""Sensors that report themselves: which, when, what, and what the edge makes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import httpx
import numpy as np
import pytest

from lab.experiments.uplinks_of_sensors import SensorUplinks, UplinkPlan
from shared.belief.records import Records, take_readings
from shared.client.edge_client import EdgeClient
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.schemas import MissionSpec
from shared.world.scenario import scenario_named
from shared.world.step_rule import Action
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, LocalPilot
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.site import Site
from simulator.world.sensors import Sensors
from tests.support.places import ROOT

Edge = Callable[..., httpx.Client]
WORLD = site_from_folder(ROOT / "examples" / "pipeline_world")
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
        send_readings = client.send_readings

        def noted(mission_id: str, request: ReadingsRequest) -> ReadingsResponse:
            sent.extend((r.step or 0, r.sensor_id, r.queue) for r in request.readings)
            return send_readings(mission_id, request)

        monkeypatch.setattr(client, "send_readings", noted)

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


class Hearing(RecedingHorizonPolicy):
    """Keeps the fleet's belief of what it hears, and flies the same way whatever that is."""

    def _plan_action(self, uav: int, taken: frozenset[int]) -> Action:
        return Action(uav, 7)


class Sink:
    """Takes readings into a belief, as an edge does."""

    def __init__(self, policy: Hearing) -> None:
        self._policy, self._records = policy, Records(WORLD.scenario)

    def send_readings(self, mission_id: str, request: ReadingsRequest) -> None:
        ids, steps, queue, battery = zip(
            *((r.sensor_id, r.step, r.queue, r.battery) for r in request.readings), strict=True
        )
        take_readings(
            np.array(ids), np.array(steps), np.array(queue), np.array(battery), self._records, self._policy.belief
        )


def error_of_what_no_uav_hears(share: float) -> float:
    """Mean error of the expected queues, packets, of the sensors that no UAV hears in a step."""
    policy = Hearing()
    pilot = LocalPilot("mpc", WORLD.scenario, 0, policy)
    uplinks = SensorUplinks(cast(EdgeClient, Sink(policy)), "test", WORLD.scenario, 0, UplinkPlan(share=share, every=3))
    errors: list[float] = []

    def decided(step: int, sensors: Sensors) -> None:
        unheard = policy.belief.heard < step
        errors.extend(np.abs(policy.belief.queue(step) - sensors.queue)[unheard])
        uplinks.send(step, sensors)

    fly(WORLD, pilot, 0, on_decided=decided)
    return float(np.mean(errors))


def test_readings_of_half_of_the_sensors_take_a_fifth_off_the_fleets_error() -> None:
    without, half, every = (error_of_what_no_uav_hears(share) for share in (0.0, 0.5, 1.0))
    assert half < 0.8 * without and every < 0.6 * without
