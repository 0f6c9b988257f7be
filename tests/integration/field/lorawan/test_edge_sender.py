"""Readings on their way to the edge: a real edge, one that is away, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest

from field.lorawan.edge_sender import EdgeSender
from field.lorawan.pending_readings import PendingReading, ReadingBuffer
from shared.wire.readings import MAX_READINGS
from tests.support.lorawan_messages import chirpstack_up, packed
from tests.unit.field.lorawan.test_pending_readings import reading_buffer

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
Handler = Callable[[httpx.Request], httpx.Response]


def taken(
    queue: float = 17, device: int = 0, f_cnt: int = 1, age_s: float = 1.0, into: ReadingBuffer | None = None
) -> ReadingBuffer:
    """A buffer with one more reading."""
    pending = into or reading_buffer()
    at = datetime.now(UTC) - timedelta(seconds=age_s)
    assert pending.add_message(packed(chirpstack_up(device=device, queue=queue, f_cnt=f_cnt, at=at))) == "accepted"
    return pending


def edge_sender(
    pending: ReadingBuffer, edge: str = "http://edge", handler: Handler | None = None, **options: float
) -> EdgeSender:
    transport = None if handler is None else httpx.MockTransport(handler)
    return EdgeSender(edge, None, pending, pending._metrics, transport, **options)


def waiting(pending: ReadingBuffer) -> list[PendingReading]:
    return [reading for readings in pending.drain().values() for reading in readings]


def counted(pending: ReadingBuffer) -> dict[str, float]:
    return {
        sample.labels["result"]: sample.value
        for metric in pending._metrics.readings.collect()
        for sample in metric.samples
        if sample.name.endswith("_total")
    }


def test_readings_enter_the_mission_of_a_real_edge(edge: Edge, report: Report) -> None:
    client = edge()
    pending = taken(queue=33.0)
    taken(queue=7.0, device=1, age_s=130.0, into=pending)
    sender = edge_sender(pending, str(client.base_url).rstrip("/"), retry_s=0.0)
    # Devices 0 and 1 are sensors 10 and 11, so the world has twelve.
    assert sender.send_pending() > 0 and counted(pending) == {"no_mission": 2}
    assert client.put("/missions/default", json={"scenario": {"name": "wide", "sensors": 12}}).status_code == 200
    sender.send_pending()
    assert counted(pending) == {"no_mission": 2, "early": 2}
    client.post("/decide", json=report(mission_id="default", step=20))
    sender.send_pending()
    assert counted(pending) == {"no_mission": 2, "early": 2, "merged": 2}
    assert client.get("/missions/default").json()["readings"] == 2
    assert waiting(pending) == []
    sender.close()


def test_a_reading_that_the_edge_refuses_takes_no_other_with_it(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/default", json={"scenario": {"name": "wide", "sensors": 12}})
    client.post("/decide", json=report(mission_id="default"))
    pending = taken(queue=30.0)
    taken(queue=61.0, device=1, into=pending)
    # Sensor 12 is unknown.
    taken(queue=30.0, device=2, into=pending)
    sender = edge_sender(pending, str(client.base_url).rstrip("/"))
    sender.send_pending()
    assert counted(pending) == {"merged": 1, "refused": 2} or counted(pending) == {"outdated": 1, "refused": 2}
    assert waiting(pending) == []
    sender.close()


@pytest.mark.parametrize("status", [401, 403, 429, 500, 502, 503, None])
def test_while_the_edge_is_away_the_newest_reading_waits(status: int | None) -> None:
    answers: list[int] = []

    def away(request: httpx.Request) -> httpx.Response:
        answers.append(len(request.content))
        if status is None:
            raise httpx.ConnectError("refused")
        return httpx.Response(status, json={"title": "no", "status": status, "detail": "no"})

    pending = taken(queue=1.0)
    sender = edge_sender(pending, handler=away)
    pauses = [sender.send_pending() for _ in range(7)]
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert len(answers) == 7
    taken(queue=2.0, f_cnt=2, age_s=0.5, into=pending)
    assert [reading.queue for reading in waiting(pending)] == [2.0]


def test_after_an_absence_everything_is_sent_and_the_pause_is_short_again() -> None:
    there = False

    def edge(request: httpx.Request) -> httpx.Response:
        if not there:
            return httpx.Response(503)
        count = request.content.count(b"sensor_id")
        return httpx.Response(200, json={"results": ["merged"] * count, "step": 3})

    pending = taken()
    for device in (1, 2):
        taken(device=device, into=pending)
    sender = edge_sender(pending, handler=edge)
    assert [sender.send_pending() for _ in range(3)] == [1.0, 2.0, 4.0]
    there = True
    assert sender.send_pending() == 1.0
    assert counted(pending) == {"merged": 3}
    there = False
    taken(f_cnt=5, age_s=0.0, into=pending)
    assert sender.send_pending() == 1.0


def test_readings_go_to_the_edge_that_has_the_mission() -> None:
    asked: list[str] = []

    def edges(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.host)
        if request.url.host != "owner":
            problem = {"title": "Misdirected", "status": 421, "detail": "there", "owner": "http://owner:8000"}
            return httpx.Response(421, json=problem)
        assert request.headers["Authorization"] == "Bearer k3y"
        return httpx.Response(200, json={"results": ["merged"], "step": 3})

    pending = taken()
    sender = EdgeSender("http://edge", "k3y", pending, pending._metrics, httpx.MockTransport(edges))
    assert sender.send_pending() == 1.0
    assert counted(pending) == {"merged": 1}
    assert asked[-1] == "owner" and len(asked) == 2


@pytest.mark.parametrize(
    "answer", [httpx.Response(200, text="<html>"), httpx.Response(200, json={"results": [], "step": 1})]
)
def test_an_answer_of_something_else_loses_nothing(answer: httpx.Response) -> None:
    pending = taken()
    edge_sender(pending, handler=lambda request: answer).send_pending()
    assert len(waiting(pending)) == 1


def test_a_mission_that_cannot_be_reached_keeps_no_other_back() -> None:
    def edges(request: httpx.Request) -> httpx.Response:
        if "/missions/default/" in request.url.path:
            raise httpx.ConnectError("the owner cannot be reached")
        return httpx.Response(200, json={"results": ["merged"], "step": 3})

    pending = taken()
    for reading in waiting(pending):
        pending.put_back([reading, replace(reading, mission_id="south")])
    sender = edge_sender(pending, handler=edges)
    assert [sender.send_pending() for _ in range(2)] == [1.0, 1.0]
    assert counted(pending) == {"merged": 1}
    assert [reading.mission_id for reading in waiting(pending)] == ["default"]


@pytest.mark.parametrize("status", [400, 413, 415, 422])
def test_one_refused_reading_costs_few_requests(status: int) -> None:
    asked: list[int] = []

    def edge(request: httpx.Request) -> httpx.Response:
        sensors = [reading["sensor_id"] for reading in json.loads(request.content)["readings"]]
        asked.append(len(sensors))
        if 77 in sensors:
            return httpx.Response(status, json={"title": "no", "status": status, "detail": "sensor 77: unknown"})
        return httpx.Response(200, json={"results": ["merged"] * len(sensors), "step": 3})

    pending = taken()
    [reading] = waiting(pending)
    pending.put_back([replace(reading, sensor_id=sensor) for sensor in range(100)])
    edge_sender(pending, handler=edge).send_pending()
    assert counted(pending) == {"merged": 99, "refused": 1}
    assert len(asked) <= 2 * 7 + 1


# 409: a mission that the edge cannot load from its store.
@pytest.mark.parametrize("status", [404, 409])
def test_readings_of_a_mission_that_the_edge_does_not_have_wait_and_are_logged_once(
    status: int, caplog: pytest.LogCaptureFixture
) -> None:
    problem = {"title": "no", "status": status, "detail": "mission_id: unknown"}
    pending = taken()
    sender = edge_sender(pending, handler=lambda request: httpx.Response(status, json=problem), retry_s=0.0)
    assert [sender.send_pending() for _ in range(3)] == [1.0, 1.0, 1.0]
    assert counted(pending) == {"no_mission": 3}
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "the readings of mission default wait: mission_id: unknown"
    ]


@pytest.mark.parametrize("capacity", [28, 55, 110])
def test_a_full_queue_is_the_capacity(capacity: int) -> None:
    sent: list[float] = []

    def edge(request: httpx.Request) -> httpx.Response:
        sent.extend(reading["queue"] for reading in json.loads(request.content)["readings"])
        return httpx.Response(200, json={"results": ["merged"], "step": 3})

    pending = taken(queue=100.0, into=reading_buffer(packets_per_unit=capacity / 100))
    edge_sender(pending, handler=edge).send_pending()
    assert sent == [capacity]


def test_a_mission_that_is_not_there_is_asked_for_after_the_pause_only_and_others_go_on() -> None:
    asked: list[str] = []

    def edge(request: httpx.Request) -> httpx.Response:
        mission = request.url.path.split("/")[2]
        asked.append(mission)
        if mission == "default":
            return httpx.Response(404, json={"title": "no", "status": 404, "detail": "mission_id: unknown"})
        return httpx.Response(200, json={"results": ["merged"], "step": 3})

    pending = taken()
    [reading] = waiting(pending)
    sender = edge_sender(pending, handler=edge, retry_s=3600.0)
    for number in range(3):
        pending.put_back([reading, replace(reading, mission_id=f"south-{number}")])
        sender.send_pending()
    assert asked == ["default", "south-0", "south-1", "south-2"]
    assert waiting(pending) == [reading]


def test_a_reading_by_a_clock_that_is_ahead_is_of_now_and_a_queue_beyond_the_wires_is_its_largest() -> None:
    sent: list[dict[str, Any]] = []

    def edge(request: httpx.Request) -> httpx.Response:
        sent.extend(json.loads(request.content)["readings"])
        return httpx.Response(200, json={"results": ["merged"], "step": 3})

    pending = taken(queue=100_001, age_s=-50.0)
    edge_sender(pending, handler=edge).send_pending()
    assert [(reading["queue"], reading["age_s"]) for reading in sent] == [(100_000, 0.0)]
    assert counted(pending) == {"merged": 1}


def test_readings_of_more_sensors_than_a_request_may_have_are_all_sent() -> None:
    asked: list[int] = []

    def edge(request: httpx.Request) -> httpx.Response:
        asked.append(len(json.loads(request.content)["readings"]))
        return httpx.Response(200, json={"results": ["merged"] * asked[-1], "step": 3})

    pending = taken()
    [reading] = waiting(pending)
    pending.put_back([replace(reading, sensor_id=sensor) for sensor in range(MAX_READINGS + 1)])
    edge_sender(pending, handler=edge).send_pending()
    assert counted(pending) == {"merged": MAX_READINGS + 1}
    assert sum(asked) == MAX_READINGS + 1 and max(asked) <= MAX_READINGS
