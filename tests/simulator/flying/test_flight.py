from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import pytest

from shared.scenario import SCENARIOS, Scenario
from simulator.client import EdgeClient
from simulator.flying.flight import Flight, fly
from simulator.flying.pilots import Choice, EdgePilot, LocalPilot
from simulator.flying.rollout import BASELINES, baselines, rollout
from simulator.flying.run import new_mission_id
from simulator.policies.registry import policy_named
from simulator.records.decision_log import DecisionLog, read_decisions
from simulator.records.summary import Flown, Summary, summarise
from simulator.sites.site import Site
from simulator.world import PipelineWorld
from tests.simulator.edge_stub import EdgeStub, free_port, stub_edge, stub_edge_at

SHORT = Scenario(steps=4)


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


@pytest.fixture
def client(stub: EdgeStub) -> Iterator[EdgeClient]:
    with EdgeClient(stub.url, timeout_s=5, attempts=2) as edge:
        yield edge


def facts(flight: Flight, deadline_ms: int | None = None) -> Flown:
    return flight.facts(
        policy="edge", edge="http://e", mission_id="m", mode="llm", model=None, deadline_ms=deadline_ms, command="c"
    )


def test_every_uav_asks_at_every_step_and_every_outcome_arrives(stub: EdgeStub, client: EdgeClient) -> None:
    pilot = EdgePilot(client, "m", SHORT, seed=0)
    flight = fly(Site(SHORT), pilot, seed=0)
    assert [(d.step, d.uav_id) for d in flight.decisions] == [(t, i) for t in range(4) for i in range(3)]
    assert [(d.step, d.uav_id) for d in stub.decides] == [(t, i) for t in range(4) for i in range(3)]
    assert pilot.answered == 12 and pilot.last_error is None

    carried = [d.outcome for d in stub.decides if d.outcome is not None]
    assert len(carried) == 9 and len(stub.feedbacks) == 3
    sent = {o.decision_id: (o.cost, o.failed) for o in (*carried, *stub.feedbacks)}
    assert sent == {d.decision_id: (d.cost, d.failed) for d in flight.decisions}


def test_the_position_recorded_is_where_the_uav_asked(stub: EdgeStub, client: EdgeClient) -> None:
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert [list(d.position) for d in flight.decisions] == [d.position for d in stub.decides]


def test_a_local_policy_flies_what_rollout_flies() -> None:
    paper = SCENARIOS["paper"]
    flight = fly(Site(paper), LocalPilot("wqcs", paper, 5), seed=5)
    expected = rollout(PipelineWorld(paper), policy_named("wqcs"), 5)
    assert [(t.lost_packets, t.events) for t in flight.tally] == [(t.lost_packets, t.events) for t in expected]
    assert {d.source for d in flight.decisions} == {"onboard"}
    assert {d.reason for d in flight.decisions} == {"policy_wqcs"}


def test_without_an_edge_the_uavs_fly_eof() -> None:
    with EdgeClient("http://127.0.0.1:1", timeout_s=1, attempts=2) as nobody:
        pilot = EdgePilot(nobody, "m", SHORT, seed=2)
        flight = fly(Site(SHORT), pilot, seed=2)
    eof = fly(Site(SHORT), LocalPilot("eof", SHORT, 2), seed=2)
    assert [(d.sensor_id, d.velocity) for d in flight.decisions] == [(d.sensor_id, d.velocity) for d in eof.decisions]
    assert {(d.source, d.reason) for d in flight.decisions} == {("onboard", "edge_unreachable")}
    assert pilot.answered == 0 and "127.0.0.1:1/decide" in str(pilot.last_error)


def test_an_edge_that_fails_for_a_while(stub: EdgeStub, client: EdgeClient) -> None:
    stub.script = ["ok", "ok", "ok", "busy", "busy", "garbage", "invalid"]
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert [d.reason for d in flight.decisions[3:6]] == ["edge_unreachable", "edge_protocol", "edge_refused"]
    assert all(d.source != "onboard" for d in flight.decisions[6:])
    # Nothing that the edge decided is left without its outcome, later though it comes.
    sent = {d.outcome.decision_id for d in stub.decides if d.outcome} | {f.decision_id for f in stub.feedbacks}
    assert sent >= {d.decision_id for d in flight.decisions if d.decision_id is not None}


def test_an_edge_that_restarted_gets_the_mission_again(stub: EdgeStub, client: EdgeClient) -> None:
    stub.script = ["ok", "ok", "ok", "forgot"]
    flight = fly(Site(SHORT), EdgePilot(client, "m-7", SHORT, seed=9), seed=9)
    assert all(d.source != "onboard" for d in flight.decisions)
    assert stub.missions["m-7"].scenario == SHORT and stub.missions["m-7"].seed == 9


def test_an_edge_that_comes_back_in_time_rejoins() -> None:
    port = free_port()
    with ExitStack() as first, ExitStack() as second, EdgeClient(f"http://127.0.0.1:{port}", timeout_s=5) as client:
        first.enter_context(stub_edge_at(port))
        again: list[EdgeStub] = []
        waits: list[str] = []
        back = threading.Timer(1.0, lambda: again.append(second.enter_context(stub_edge_at(port))))

        def goes_away(flight: Flight) -> None:
            if flight.steps_flown == 1:
                first.close()
                back.start()

        pilot = EdgePilot(client, "m", SHORT, seed=9, reconnect_s=20, on_wait=waits.append)
        flight = fly(Site(SHORT), pilot, 9, on_step=goes_away)
        back.join()
        assert [d.source == "onboard" for d in flight.decisions] == [False] * 3 + [True] * 3 + [False] * 6
        assert waits and again[0].missions["m"] == pilot.spec


def test_an_edge_that_stays_away_costs_one_pause() -> None:
    with (
        EdgeClient(f"http://127.0.0.1:{free_port()}", timeout_s=1, attempts=1) as nobody,
        patch.object(nobody, "wait_ready", wraps=nobody.wait_ready) as pauses,
    ):
        flight = fly(Site(SHORT), EdgePilot(nobody, "m", SHORT, seed=0, reconnect_s=3), seed=0)
    assert [pause.args for pause in pauses.call_args_list] == [(3,)]
    assert {d.source for d in flight.decisions} == {"onboard"} and flight.steps_flown == 4


def test_an_interrupt_keeps_the_whole_steps(stub: EdgeStub, client: EdgeClient, tmp_path: Path) -> None:
    def interrupt(choice: Choice) -> None:
        if stub.asked == 8:
            raise KeyboardInterrupt

    with DecisionLog(tmp_path / "d.jsonl") as log:
        flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), 0, log, on_decision=interrupt)
    assert flight.interrupted and flight.steps_flown == 2
    assert read_decisions(tmp_path / "d.jsonl") == flight.decisions and len(flight.decisions) == 6
    others = baselines(Site(SHORT), 0, flight.steps_flown)
    assert {name: len(tally) for name, tally in others.items()} == {"eof": 2, "wqcs": 2}


def test_the_summary_has_these_keys(stub: EdgeStub, client: EdgeClient) -> None:
    stub.script = ["slow"]
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0, deadline_ms=200), seed=0)
    summary = summarise(
        facts(flight, deadline_ms=200), flight.decisions, {"aic_vds": flight.tally, **baselines(Site(SHORT), 0, 4)}
    )
    told = summary.model_dump()
    assert set(told) == {
        *("scenario", "seed", "steps", "uavs", "sensors", "decisions", "by_source", "lost_packets", "loss_events"),
        *("tokens", "rtt_ms", "uplink_bytes_mean", "uplink", "attention_bytes_mean", "jain"),
        *("by_reason", "late", "failures", "model", "edge", "mission_id", "mode", "interrupted", "steps_flown"),
        *("started_at", "duration_s", "version", "policy", "deadline_ms", "command", "llm_asked"),
    }
    assert set(told["by_source"]) == {"llm", "guided", "value", "policy", "onboard"}
    assert set(told["lost_packets"]) == set(told["loss_events"]) == {"aic_vds", *BASELINES}
    assert set(told["rtt_ms"]) == {"p50", "p99"}
    assert told["by_source"] == {"llm": 9, "guided": 0, "value": 0, "policy": 3, "onboard": 0}
    assert told["by_reason"] == {"llm_timeout": 3}
    assert told["late"] >= 1 and told["llm_asked"] == 12 and told["model"] == "stub-1"
    assert told["tokens"] == {
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


def test_mission_ids_differ() -> None:
    first, second = (new_mission_id(SHORT, 0) for _ in range(2))
    assert first.startswith("paper-0-") and first != second
