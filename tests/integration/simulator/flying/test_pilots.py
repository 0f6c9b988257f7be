"""The pilot that asks an edge: outcomes, outages, and the fallback on board."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from unittest.mock import patch

import pytest

from shared.client.calls import Exchange
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeError, EdgeRefused, EdgeUnreachable
from shared.wire.problem import Problem
from shared.wire.schemas import DecideRequest
from shared.world.scenario import Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, LocalPilot
from simulator.records.flight import Flight
from simulator.sites.site import Site
from simulator.world.observation import Observation
from tests.conftest import Edge
from tests.support.edge_stub import EdgeStub, free_port, stub_edge, stub_edge_at
from tests.support.waiting import PATIENCE_S

SHORT = Scenario(steps=4)


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


@pytest.fixture
def client(stub: EdgeStub) -> Iterator[EdgeClient]:
    with EdgeClient(stub.url, timeout_s=PATIENCE_S, attempts=2) as edge:
        yield edge


def test_a_policys_choice_must_be_whole_numbers() -> None:
    class Slow:
        def reset(self, scenario: Scenario, seed: int) -> None: ...

        def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
            return 3, 7.5  # type: ignore[return-value]

    with pytest.raises(ValueError, match=r"UAV 0, step 0: \(3, 7\.5\) are not two whole numbers"):
        fly(Site(SHORT), LocalPilot("slow", SHORT, 0, Slow()), seed=0)


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


def test_without_an_edge_the_longest_queues_are_flown() -> None:
    with EdgeClient("http://127.0.0.1:1", timeout_s=1, attempts=2) as unreachable:
        pilot = EdgePilot(unreachable, "m", SHORT, seed=2)
        flight = fly(Site(SHORT), pilot, seed=2)
    longest = fly(Site(SHORT), LocalPilot("longest_queue", SHORT, 2), seed=2)
    assert [(d.sensor_id, d.velocity) for d in flight.decisions] == [
        (d.sensor_id, d.velocity) for d in longest.decisions
    ]
    assert {(d.source, d.reason) for d in flight.decisions} == {("onboard", "edge_unreachable")}
    assert pilot.answered == 0 and "127.0.0.1:1/decide" in str(pilot.last_error)


def test_an_edge_that_fails_for_a_while(stub: EdgeStub, client: EdgeClient) -> None:
    stub.script = ["ok", "ok", "ok", "busy", "busy", "garbage", "invalid"]
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert [d.reason for d in flight.decisions[3:6]] == ["edge_unreachable", "edge_protocol", "edge_refused"]
    assert all(d.source != "onboard" for d in flight.decisions[6:])
    # Every decision of the edge gets its outcome, if late.
    sent = {d.outcome.decision_id for d in stub.decides if d.outcome} | {f.decision_id for f in stub.feedbacks}
    assert sent >= {d.decision_id for d in flight.decisions if d.decision_id is not None}


def test_a_lost_edge_is_asked_once_for_each_decision_until_it_answers(stub: EdgeStub, client: EdgeClient) -> None:
    # The client's two attempts, then single ones; after an answer two again.
    stub.script = ["busy", "busy", "busy", "busy", "ok", "busy", "busy", "ok"]
    flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert [d.source == "onboard" for d in flight.decisions] == [True] * 3 + [False, True] + [False] * 7
    assert stub.request_count == 8 + 6


def test_an_edge_that_restarted_gets_the_mission_again(stub: EdgeStub, client: EdgeClient) -> None:
    stub.script = ["ok", "ok", "ok", "forgot"]
    flight = fly(Site(SHORT), EdgePilot(client, "m-7", SHORT, seed=9), seed=9)
    assert all(d.source != "onboard" for d in flight.decisions)
    assert stub.missions["m-7"].scenario == SHORT and stub.missions["m-7"].seed == 9


def test_a_decision_that_the_edge_has_lost_costs_its_outcome_alone(stub: EdgeStub, client: EdgeClient) -> None:
    """The mission was made by `aicvds mission create`, with a note of its own."""
    stub.script = ["ok", "ok", "ok", "forgot"]
    other = EdgeRefused("url", Problem(detail="mission m-7 has another spec"), 409)
    with patch.object(client, "put_mission", side_effect=other):
        flight = fly(Site(SHORT), EdgePilot(client, "m-7", SHORT, seed=9), seed=9)
    assert all(d.source != "onboard" for d in flight.decisions)


@pytest.mark.parametrize(
    ("failure", "sent"),
    [(EdgeRefused("url", Problem(detail="decision unknown"), 404), 3), (EdgeUnreachable("no edge"), 1)],
)
def test_an_outcome_that_is_refused_at_landing_keeps_no_other_back_and_a_lost_edge_gets_no_more(
    failure: EdgeError, sent: int, client: EdgeClient
) -> None:
    pilot = EdgePilot(client, "m", SHORT, seed=0)
    with patch.object(client, "feedback", side_effect=failure) as feedback:
        fly(Site(SHORT), pilot, seed=0)
    assert feedback.call_count == sent and pilot.last_error == str(failure)


def test_an_outcome_that_the_edge_could_not_store_is_sent_again_at_landing(stub: EdgeStub, client: EdgeClient) -> None:
    decide = client.decide

    def without_a_disk_in_step_2(request: DecideRequest, attempts: int | None = None) -> Exchange:
        exchange = decide(request, attempts)
        return replace(exchange, response=exchange.response.model_copy(update={"stored": request.step != 2}))

    with patch.object(client, "decide", side_effect=without_a_disk_in_step_2):
        flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    again = [d.decision_id for d in flight.decisions if d.step == 1]
    assert [f.decision_id for f in stub.feedbacks] == again + [d.decision_id for d in flight.decisions if d.step == 3]


def test_losses_beyond_a_cost_are_the_highest_cost(stub: EdgeStub, client: EdgeClient) -> None:
    pilot = EdgePilot(client, "m", SHORT, seed=0)
    flight = fly(Site(SHORT), pilot, seed=0)
    choice = next(d for d in flight.decisions)
    assert choice.decision_id is not None
    exchange = client.decide(stub.decides[0])
    assert exchange.outcome(2.0**31, True).cost == 10_000.0


def test_a_key_from_a_file_loses_its_newline(stub: EdgeStub) -> None:
    with EdgeClient(stub.url, timeout_s=PATIENCE_S, api_key="aicvds_secret\n") as client:
        fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0), seed=0)
    assert {headers["authorization"] for headers in stub.headers} == {"Bearer aicvds_secret"}


def test_a_mission_that_the_edge_has_lost_is_made_again(edge: Edge) -> None:
    with EdgeClient(str(edge().base_url), timeout_s=PATIENCE_S) as client:
        pilot = EdgePilot(client, "m-7", SHORT, seed=9)

        def lost(flight: Flight) -> None:
            if flight.steps_flown == 2:
                client.delete_mission("m-7")

        # The edge has none at first either.
        flight = fly(Site(SHORT), pilot, seed=9, on_step=lost)
        status = client.mission("m-7")
    assert all(d.source != "onboard" for d in flight.decisions), pilot.last_error
    assert status.scenario == SHORT and status.decisions == status.feedback == 3 * 2


def test_an_edge_that_comes_back_in_time_rejoins() -> None:
    port = free_port()
    with (
        ExitStack() as first,
        ExitStack() as second,
        EdgeClient(f"http://127.0.0.1:{port}", timeout_s=PATIENCE_S) as client,
    ):
        first.enter_context(stub_edge_at(port)).velocity = 3
        again: list[EdgeStub] = []
        waits: list[str] = []

        def goes_away(flight: Flight) -> None:
            if flight.steps_flown == 1:
                first.close()

        def comes_back(state: str) -> None:
            waits.append(state)
            if not again:
                again.append(second.enter_context(stub_edge_at(port)))

        pilot = EdgePilot(client, "m", SHORT, seed=9, reconnect_s=PATIENCE_S, on_wait=comes_back)
        flight = fly(Site(SHORT), pilot, 9, on_step=goes_away)
        assert [d.source == "onboard" for d in flight.decisions] == [False] * 3 + [True] * 3 + [False] * 6
        assert waits and again[0].missions["m"] == pilot.spec
        velocities = [[d.velocity for d in flight.decisions if d.uav_id == uav] for uav in range(3)]
        assert [flown[:2] for flown in velocities] == [[3, 3]] * 3, "on board it keeps the edge's last velocity"


def test_every_outage_is_waited_for_as_long_as_the_first(stub: EdgeStub) -> None:
    stub.script = ["busy", "busy", "busy", "ok", "ok", "ok", "busy", "busy", "busy"]
    with (
        EdgeClient(stub.url, timeout_s=PATIENCE_S, attempts=1) as client,
        patch.object(client, "wait_ready", wraps=client.wait_ready) as pauses,
    ):
        flight = fly(Site(SHORT), EdgePilot(client, "m", SHORT, seed=0, reconnect_s=PATIENCE_S), seed=0)
    assert [d.source == "onboard" for d in flight.decisions] == ([True] * 3 + [False] * 3) * 2
    assert [pause.args for pause in pauses.call_args_list] == [(PATIENCE_S,)] * 2


def test_an_edge_that_stays_away_costs_one_pause() -> None:
    with (
        EdgeClient(f"http://127.0.0.1:{free_port()}", timeout_s=1, attempts=1) as unreachable,
        patch.object(unreachable, "wait_ready", wraps=unreachable.wait_ready) as pauses,
    ):
        flight = fly(Site(SHORT), EdgePilot(unreachable, "m", SHORT, seed=0, reconnect_s=0.2), seed=0)
    assert [pause.args for pause in pauses.call_args_list] == [(0.2,)]
    assert {d.source for d in flight.decisions} == {"onboard"} and flight.steps_flown == 4
