from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from pydantic import BaseModel, model_serializer
from pydantic_core import PydanticSerializationError

from shared.client.edge_client import EdgeClient
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import baselines, fly, rollout
from simulator.flying.job import BASELINES
from simulator.flying.pilots import EdgePilot, LocalPilot, PilotChoice
from simulator.policies.registry import policy_named
from simulator.records.flight import Flight
from simulator.records.mission_logs import DecisionLog, read_decisions
from simulator.records.summary import FlightFacts, Summary, summarise
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from tests.support.edge_stub import EdgeStub, stub_edge
from tests.support.waiting import PATIENCE_S, Clock, until

SHORT = Scenario(steps=4)


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


@pytest.fixture
def client(stub: EdgeStub) -> Iterator[EdgeClient]:
    with EdgeClient(stub.url, timeout_s=PATIENCE_S, attempts=2) as edge:
        yield edge


def facts(flight: Flight, deadline_ms: int | None = None) -> FlightFacts:
    return flight.facts(
        policy="edge", edge="http://e", mission_id="m", mode="llm", model=None, deadline_ms=deadline_ms, command="c"
    )


def test_the_position_recorded_is_that_of_the_request(stub: EdgeStub, client: EdgeClient) -> None:
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert [list(d.position) for d in flight.decisions] == [d.position for d in stub.decides]


def test_a_local_policy_flies_as_in_rollout() -> None:
    paper = SCENARIOS["paper"]
    flight = fly(Site(paper), LocalPilot("wqcs", paper, 5), seed=5)
    expected = rollout(PipelineWorld(paper), policy_named("wqcs"), 5)
    assert [(t.lost_packets, t.events) for t in flight.tally] == [(t.lost_packets, t.events) for t in expected]
    assert {d.source for d in flight.decisions} == {"onboard"}
    assert {d.reason for d in flight.decisions} == {"policy_wqcs"}


class Interrupted(BaseModel):
    """An interrupt comes while pydantic writes the model."""

    cause: type[BaseException]

    @model_serializer
    def written(self) -> str:
        raise self.cause


def within_pydantic() -> None:
    Interrupted(cause=KeyboardInterrupt).model_dump_json()


def between_two_instructions() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("interrupted", [between_two_instructions, within_pydantic])
def test_an_interrupt_keeps_the_whole_steps(
    stub: EdgeStub, client: EdgeClient, tmp_path: Path, interrupted: Callable[[], None]
) -> None:
    def interrupt(choice: PilotChoice) -> None:
        if stub.request_count == 8:
            interrupted()

    with DecisionLog(tmp_path / "d.jsonl") as log:
        flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), 0, log, on_decision=interrupt)
    assert flight.interrupted and flight.steps_flown == 2
    assert read_decisions(tmp_path / "d.jsonl") == flight.decisions and len(flight.decisions) == 6
    others = baselines(Site(SHORT), 0, flight.steps_flown)
    assert {name: len(tally) for name, tally in others.items()} == {"eof": 2, "wqcs": 2}


def test_a_model_that_cannot_be_written_is_no_interrupt(client: EdgeClient) -> None:
    def fail(choice: PilotChoice) -> None:
        Interrupted(cause=ValueError).model_dump_json()

    with pytest.raises(PydanticSerializationError, match="ValueError"):
        fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), 0, on_decision=fail)


def test_the_summary_has_these_keys(stub: EdgeStub) -> None:
    clock = Clock()
    stub.script = ["slow"]

    def take_an_hour() -> None:
        until(lambda: stub.gate.callers)
        clock.ahead_s = 3600.0
        stub.gate.open()

    client = EdgeClient(stub.url, timeout_s=PATIENCE_S, clock=clock.perf_counter)
    with client, ThreadPoolExecutor(1) as executor:
        executor.submit(take_an_hour)
        flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0, deadline_ms=60_000), seed=0)
    summary = summarise(
        facts(flight, deadline_ms=60_000), flight.decisions, {"aic_vds": flight.tally, **baselines(Site(SHORT), 0, 4)}
    )
    fields = summary.model_dump()
    assert set(fields) == {
        *("scenario", "seed", "steps", "uavs", "sensors", "decisions", "by_source", "lost_packets", "loss_events"),
        *("tokens", "rtt_ms", "uplink_bytes_mean", "uplink", "attention_bytes_mean", "jain", "without_llm"),
        *("by_reason", "late", "failures", "model", "edge", "mission_id", "mode", "interrupted", "steps_flown"),
        *("started_at", "duration_s", "version", "policy", "deadline_ms", "command", "llm_asked"),
        *("trust", "bound", "bound_missing", "operator"),
    }
    assert set(fields["by_source"]) == {"llm", "guided", "value", "policy", "onboard"}
    assert set(fields["lost_packets"]) == set(fields["loss_events"]) == {"aic_vds", *BASELINES}
    assert set(fields["rtt_ms"]) == {"p50", "p99"}
    assert fields["by_source"] == {"llm": 9, "guided": 0, "value": 0, "policy": 3, "onboard": 0}
    assert fields["by_reason"] == {"llm_timeout": 3}
    assert fields["late"] == 1 and fields["llm_asked"] == 12 and fields["model"] == "stub-1"
    assert fields["tokens"] == {
        "prompt_mean": 255.0,
        "uncompressed_mean": 305.0,
        "saved_pct": pytest.approx(100 * 50 / 305),
        "cached_mean": 200.0,
        "cached_pct": 80.0,
        "state_mean": 40.0,
        "state_uncompressed_mean": 90.0,
        "state_saved_pct": pytest.approx(100 * 50 / 90),
    }
    assert Summary.model_validate_json(summary.model_dump_json()) == summary
