"""What a client takes as an answer to its own request, and what it says of the round trip."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from shared.client.calls import Exchange
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeProtocolError
from shared.wire.schemas import MAX_ROUND_TRIP_MS, DecideRequest, DecideResponse, SensorColumns, Tokens
from shared.world.scenario import Scenario

WORLD = Scenario(name="small", sensors=4, max_velocity=9)


def answer(**changes: Any) -> DecideResponse:
    counts = ("static", "experiences", "state", "state_uncompressed", "prompt", "uncompressed", "saved")
    fields: dict[str, Any] = {
        "decision_id": "d" * 32,
        "mission_id": "m",
        "uav_id": 1,
        "step": 5,
        "sensor_id": 3,
        "velocity": 9,
        "source": "policy",
        "top_k": [],
        "tokens": Tokens(tokenizer="none", **dict.fromkeys(counts, 0)),
        "deadline_ms": 500,
        "latency_ms": {},
    }
    return DecideResponse(**fields | changes)


def exchange(rtt_ms: float = 1.0, **changes: Any) -> Exchange:
    return Exchange(answer(**changes), rtt_ms, 1, 100, 100)


def test_the_last_sensor_and_the_highest_velocity_are_the_worlds_and_the_next_ones_are_not() -> None:
    assert exchange().within(WORLD).response.sensor_id == 3
    for beyond in ({"sensor_id": 4}, {"velocity": 10}):
        with pytest.raises(EdgeProtocolError, match="there are 4 sensors and at most 9 m/s"):
            exchange(**beyond).within(WORLD)


def test_a_round_trip_is_told_to_a_microsecond_and_at_most_the_wires_longest() -> None:
    reported = [exchange(rtt_ms).outcome(0.5, False).round_trip_ms for rtt_ms in (12.34567, 2 * MAX_ROUND_TRIP_MS)]
    assert reported == [12.346, MAX_ROUND_TRIP_MS]


@pytest.mark.parametrize("of", [{"step": 4}, {"uav_id": 0}])
def test_an_answer_to_another_request_is_none(of: dict[str, int]) -> None:
    columns = SensorColumns(id=[0], x=[1.0], y=[1.0], queue=[3.0], battery=[4.0], channel_gain=[-90.0], last_seen=[5])
    request = DecideRequest(mission_id="m", uav_id=1, step=5, position=[0.0, 0.0], sensors=columns)
    transport = httpx.MockTransport(lambda sent: httpx.Response(200, text=answer(**of).model_dump_json()))
    other = pytest.raises(EdgeProtocolError, match="answered for another UAV or step")
    with EdgeClient("http://edge", transport=transport) as edge, other:
        edge.decide(request)
