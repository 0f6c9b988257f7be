"""A flight of real UAVs whose radio or edge fails in part."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from field.vehicles.field_pilot import FieldPilot
from field.vehicles.field_run import FieldJob, join_mission
from field.vehicles.radio import Beacon, Collected, Spot
from shared.client.calls import Exchange
from shared.client.edge_client import AsyncEdgeClient
from shared.client.errors import EdgeRefused
from shared.wire.problem import Problem
from shared.wire.schemas import DecideRequest, FeedbackRequest, FeedbackResponse
from shared.world.scenario import SCENARIOS
from simulator.flying.pilots import PilotChoice
from tests.conftest import Edge
from tests.integration.field.vehicles.test_field_flight import Counting, Trial, nobody
from tests.support.edge_stub import stub_edge
from tests.support.waiting import PATIENCE_S


class Failing(Counting):
    """At step 1 the gain has the wrong sign, at step 2 nothing can be heard, and at its end nothing collected."""

    async def beacons(self, spot: Spot) -> dict[int, Beacon]:
        if spot.step == 2:
            raise TimeoutError("no modem")
        return {0: Beacon(30, 40.0, 93.0 if spot.step == 1 and spot.uav == 1 else -90.0, 0)}

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        if spot.step == 2:
            raise OSError("no port")
        return Collected(5, failed=False)


async def test_a_radio_that_fails_ends_no_flight(edge: Edge) -> None:
    trial = Trial(steps=5)
    trial.radio = Failing([])
    flown = await trial.fly(str(edge(mode="policy").base_url))
    assert flown.steps_flown == 5
    by_step = [[d.source for d in flown.decisions if d.step == step] for step in range(5)]
    assert [sources.count("onboard") for sources in by_step] == [0, 1, 1, 0, 0]
    assert {d.reason for d in flown.decisions if d.source == "onboard"} == {"report_invalid"}
    assert trial.last_error is not None and "channel_gain" in trial.last_error
    assert [d.failed for d in flown.decisions if d.step == 2] == [True] * 3
    assert {"its radio fails: TimeoutError: no modem", "its radio fails: OSError: no port"} <= {
        text for _, text in trial.events
    }


class Silent(Counting):
    """From step 1 on the first UAV's receiver never answers."""

    async def beacons(self, spot: Spot) -> dict[int, Beacon]:
        if spot.step > 0 and spot.uav == 0:
            await asyncio.Event().wait()
        return {0: Beacon(30, 40.0, -90.0, 0)}


async def test_a_radio_that_never_answers_stops_no_flight() -> None:
    trial = Trial(steps=3)
    scenario = trial.site.scenario.model_copy(update={"step_s": 0.05})
    trial.site = replace(trial.site, scenario=scenario)
    trial.radio = Silent([])
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.steps_flown == 3 and len([d for d in flown.decisions if d.uav_id != 0]) == 6
    assert (0, "its radio fails: TimeoutError") in trial.events


async def test_an_outcome_that_is_refused_at_landing_keeps_no_other_back() -> None:
    sent: list[str] = []

    class Refusing(AsyncEdgeClient):
        async def feedback(self, outcome: FeedbackRequest) -> FeedbackResponse:
            sent.append(outcome.decision_id)
            if len(sent) == 1:
                raise EdgeRefused("url", Problem(detail="unknown decision"), 404)
            return FeedbackResponse(decision_id=outcome.decision_id, result="applied")

    async with Refusing(nobody()) as client:
        pilot = FieldPilot(client, "field", SCENARIOS["paper"], PATIENCE_S)
        for uav in range(3):
            answer: Any = SimpleNamespace(decision_id=f"{uav:032x}")
            pilot.learn(uav, PilotChoice(0, 7, "policy", "mode_policy", Exchange(answer, 1.0, 1, 1, 1)), 0.0, False)
        await pilot.land()
    assert len(sent) == 3 and pilot.last_error is not None and "unknown decision" in pilot.last_error


async def test_an_outcome_that_the_edge_could_not_store_is_sent_again_at_landing() -> None:
    class Unstoring(AsyncEdgeClient):
        """Its edge's disk fails at step 1."""

        async def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
            found = await super().decide(request, attempts)
            return replace(found, response=found.response.model_copy(update={"stored": request.step != 1}))

    trial, given = Trial(), []
    with stub_edge() as edge:
        async with Unstoring(edge.url, timeout_s=PATIENCE_S) as client:
            pilot = FieldPilot(client, "field", trial.site.scenario, PATIENCE_S)
            await trial.uavs[0].update(0.0)
            for step in range(4):
                choice = (await pilot.decide({0: trial.uavs[0].observation(step)}))[0]
                assert choice.exchange is not None
                given.append(choice.exchange.response.decision_id)
                pilot.learn(0, choice, cost=0.25, failed=False)
            await pilot.land()
    assert [request.outcome and request.outcome.decision_id for request in edge.decides] == [None, *given[:3]]
    # The first decision's outcome came with the second request, and the last one's with none.
    assert [outcome.decision_id for outcome in edge.feedbacks] == [given[0], given[3]]
    assert {outcome.cost for outcome in edge.feedbacks} == {0.25}


async def test_a_mission_that_was_flown_before_is_named(edge: Edge, capsys: pytest.CaptureFixture[str]) -> None:
    trial, url = Trial(steps=1), str(edge(mode="policy").base_url)
    job = cast(FieldJob, SimpleNamespace(mission_id="field", edge=url))
    for expected in (None, "it has 3 decisions already: if they are of an earlier flight, DELETE it first"):
        async with AsyncEdgeClient(url, timeout_s=PATIENCE_S) as client:
            await join_mission(FieldPilot(client, "field", trial.site.scenario, PATIENCE_S), job)
        printed = "".join(capsys.readouterr())
        assert "mission field, mode policy; watch it at" in printed
        assert ("decisions already" in printed) == (expected is not None) and (expected or "") in printed
        await trial.fly(url)
