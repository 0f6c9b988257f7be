"""Missions over real HTTP on each uplink: delta decides as full does, to the bit, whatever is lost on the way."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from shared.client.edge_client import EdgeClient
from shared.wire.schemas import FeedbackRequest, Uplink
from shared.world.scenario import SCENARIOS
from simulator.flying.edge_session import LossyTransport
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.records.flight import Flight
from simulator.sites.site import Site
from simulator.world.observation import Observation
from tests.conftest import Edge
from tests.support.edge_stub import free_port
from tests.support.processes import output_until, run_here, serving_edge, started
from tests.support.waiting import PATIENCE_S, until

SCENARIO = SCENARIOS["paper"].model_copy(update={"steps": 12})


class Patient(EdgePilot):
    """Tells each outcome on its own, and asks when all are learned from: what is learned beside decides by chance."""

    def __init__(self, client: EdgeClient, mission_id: str) -> None:
        super().__init__(client, mission_id, SCENARIO, 0, mode="value")
        self._edge, self._name = client, mission_id

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        until(self._learned, lambda: self._edge.mission(self._name))
        return super().decide(uav, observation, taken)

    def _learned(self) -> bool:
        reported = self._edge.mission(self._name)
        return reported.learner_updates == reported.feedback

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        assert choice.exchange is not None, self.last_error
        outcome = choice.exchange.outcome(cost, failed)
        self._edge.feedback(FeedbackRequest(mission_id=self._name, **outcome.model_dump()))


class Deaf(httpx.HTTPTransport):
    """Loses every third answer: the edge has decided, and the UAV does not know."""

    def __init__(self) -> None:
        super().__init__()
        self._random = random.Random(0)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        response = super().handle_request(request)
        if request.url.path == "/decide" and self._random.random() < 0.3:
            response.read()
            raise httpx.ReadTimeout("the uplink lost the answer", request=request)
        return response


def flown(
    url: str,
    uplink: Uplink,
    mission_id: str,
    transport: httpx.BaseTransport | None = None,
    on_step: Callable[[Flight], None] | None = None,
) -> Flight:
    with EdgeClient(url, timeout_s=PATIENCE_S, attempts=20, uplink=uplink, transport=transport) as client:
        pilot = Patient(client, mission_id)
        with EdgeClient(url, timeout_s=PATIENCE_S) as ground:
            ground.put_mission(mission_id, pilot.spec)
        flight = fly(Site(SCENARIO), pilot, seed=0, on_step=on_step)
    assert pilot.last_error is None
    return flight


def decided(flight: Flight) -> list[Any]:
    return [(d.step, d.uav_id, d.source, d.sensor_id, d.velocity, d.top_k, d.cost) for d in flight.decisions]


def mean_bytes(flight: Flight) -> float:
    return sum(d.request_bytes for d in flight.decisions) / len(flight.decisions)


def test_delta_decides_as_full_to_the_bit_with_fewer_bytes(edge: Edge) -> None:
    url = str(edge().base_url)
    full, delta = flown(url, "full", "full"), flown(url, "delta", "delta")
    assert decided(delta) == decided(full)
    # A UAV's first is full.
    assert [d.request_bytes > 600 for d in delta.decisions] == [d.step == 0 for d in delta.decisions]
    assert mean_bytes(delta) < 0.5 * mean_bytes(full)


def test_delta_is_right_where_requests_and_answers_are_lost(edge: Edge) -> None:
    url = str(edge().base_url)
    lossy = LossyTransport(Deaf(), drop=0.3, jitter_ms=2, seed=0)
    full, delta = flown(url, "full", "full"), flown(url, "delta", "delta", lossy)
    with EdgeClient(url, timeout_s=PATIENCE_S) as ground:
        # The edge decides once for a request that is sent again.
        assert ground.mission("delta").decisions == len(delta.decisions)
    assert max(d.attempts for d in delta.decisions) > 1
    assert decided(delta) == decided(full)


@pytest.mark.long
def test_an_edge_that_is_killed_on_the_way(tmp_path: Path) -> None:
    port = str(free_port())
    common = {"AICVDS_MODE": "value", "AICVDS_STORE": str(tmp_path / "m.db")}
    with serving_edge(**common) as (url, _):
        full = flown(url, "full", "full")
    with ExitStack() as stack:
        edge = stack.enter_context(started("serve", "--port", port, **common))
        output_until(edge, "listening on")

        def restarted(flight: Flight) -> None:
            if flight.steps_flown == 6:
                edge.kill()
                edge.wait(PATIENCE_S)
                output_until(stack.enter_context(started("serve", "--port", port, **common)), "listening on")

        cut = flown(f"http://127.0.0.1:{port}", "delta", "cut", on_step=restarted)
    assert decided(cut) == decided(full)
    by_step = {step: [d.request_bytes for d in cut.decisions if d.step == step] for step in (5, 6, 7)}
    # The edge that was started anew holds no report: each UAV told all of it once more.
    assert min(by_step[6]) > 1000 > max(by_step[5] + by_step[7])


def test_pruned_reports_name_k_sensors_and_the_rest_is_known(edge: Edge) -> None:
    asked: list[dict[str, Any]] = []

    class Tapped(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path == "/decide":
                asked.append(json.loads(request.content))
            return super().handle_request(request)

    flight = flown(str(edge().base_url), "pruned", "pruned", Tapped())
    assert [len(body["sensors"]["id"]) for body in asked] == [10] * 3 + [5] * 33
    assert [d.attention_bytes > 0 for d in flight.decisions] == [d.step in (0, 10) for d in flight.decisions]
    for body, decision in zip(asked, flight.decisions, strict=True):
        assert decision.sensor_id in body["sensors"]["id"] and ("x" in body["sensors"]) == (decision.step == 0)
        assert {c.sensor_id for c in decision.top_k} <= set(body["sensors"]["id"])


def test_pruned_reports_are_told_in_full_to_an_edge_that_forgot(edge: Edge) -> None:
    url = str(edge().base_url)

    def forget(flight: Flight) -> None:
        if flight.steps_flown == 6:
            httpx.delete(f"{url}/missions/pruned").raise_for_status()
            httpx.put(f"{url}/missions/pruned", json={"mode": "value"}).raise_for_status()

    flight = flown(url, "pruned", "pruned", on_step=forget)
    assert {d.source for d in flight.decisions} == {"value"}
    # The first UAV tells all, and where it is: the others' k sensors are known by that.
    again = [d for d in flight.decisions if d.step >= 1 and d.request_bytes > 900]
    assert [(d.step, d.uav_id) for d in again] == [(6, 0)]


@pytest.mark.long
def test_simulate_tells_the_uplink_and_its_bytes(edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its figures for print are not looked at.
    monkeypatch.setattr("simulator.reporting.figure_style.PaperFigure.write", lambda *_: [])
    reported, flight = {}, ("--edge", str(edge().base_url), "--steps", "6", "--deadline-ms", "60000")
    for uplink in ("full", "delta", "pruned"):
        out = tmp_path / uplink
        done = run_here("simulate", *flight, "--uplink", uplink, "--out", str(out))
        assert done.returncode == 0, done.stderr
        assert f"Uplink {uplink}: " in done.stdout
        reported[uplink] = json.loads((out / "summary.json").read_text())
        assert reported[uplink]["uplink"] == uplink and f"uplink {uplink}" in (out / "report.html").read_text()
        # In full, whatever was sent: it can be asked again.
        lines = (out / "requests.jsonl").read_text().splitlines()[1:]
        assert {len(json.loads(line)["sensors"]["x"]) for line in lines} == {10}
    sizes = {uplink: summary["uplink_bytes_mean"] for uplink, summary in reported.items()}
    assert max(sizes["delta"], sizes["pruned"]) < 0.7 * sizes["full"]
    assert reported["pruned"]["attention_bytes_mean"] > reported["full"]["attention_bytes_mean"] == 0
