"""An LLM server that turns bad in mid-flight: every decision comes in time, says why, and the edge recovers."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import httpx
import pytest
import trustme
import uvicorn

from tests.faults.fleet import Report, ask, resident_mb
from tests.faults.table import Tables
from tests.support.processes import serving_edge
from tests.support.running import Handler, listening
from tests.support.stub_llm import FAULTS, bomb, http_answer, misbehaving, wait_for

pytestmark = [pytest.mark.faults, pytest.mark.timeout(300)]

DECISIONS, DEADLINE_MS, SLACK_MS = 1000, 300, 50
TITLE = "The LLM's server"


def completion(text: str) -> Handler:
    return http_answer(b"200 OK", json.dumps({"choices": [{"message": {"content": text}}]}).encode())


async def a_byte_a_second(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 1000\r\n\r\n")
    while True:
        writer.write(b" ")
        await writer.drain()
        await asyncio.sleep(1)


Address = Callable[[], AbstractContextManager[str]]

UPSTREAMS = {name: handler for name, (handler, _) in FAULTS.items() if name != "dripping"} | {
    "a byte a second": a_byte_a_second,
    "wrong sensor": completion("9 7"),
    "prose": completion("I would fly to sensor 3, because its queue is nearly full."),
}
# They answer with something, so that the server counts as well.
ANSWERED = ("wrong sensor", "prose")


class Switch:
    """A server that is well until it is told otherwise."""

    def __init__(self) -> None:
        self.well = completion("0 7")
        self.fault: Handler | None = None

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await (self.fault or self.well)(reader, writer)


def opened(client: httpx.Client) -> int:
    line = next(x for x in client.get("/metrics").text.splitlines() if x.startswith("aicvds_llm_breaker_opened_total"))
    return int(float(line.split()[1]))


@pytest.mark.parametrize("name", UPSTREAMS)
def test_a_server_that_turns_bad(name: str, report: Report, tables: Tables) -> None:
    switch = Switch()
    with (
        listening(misbehaving(switch)) as llm,
        serving_edge(
            AICVDS_LLM_URL=f"{llm}/v1", AICVDS_MODE="llm", AICVDS_PLANNER="off", AICVDS_DEADLINE_MS=str(DEADLINE_MS)
        ) as (url, process),
        httpx.Client(base_url=url, timeout=10) as client,
    ):
        wait_for(client, "ready")
        # Not while a UAV waits.
        bomb()
        warm = ask(url, report, 300, DEADLINE_MS)
        assert warm.reasons["none"] > 250, warm.reported()
        before_mb = resident_mb(process.pid)
        switch.fault = UPSTREAMS[name]
        asked = ask(url, report, DECISIONS, DEADLINE_MS, first_step=100)
        grown_mb = resident_mb(process.pid) - before_mb
        switch.fault = None
        times_opened = opened(client)
        wait_for(client, "ready")
        again = ask(url, report, 90, DEADLINE_MS, first_step=450)
        tables.add(
            TITLE,
            fault=name,
            decisions=len(asked.late_ms),
            in_time=f"{asked.within(SLACK_MS):.1%}",
            latest_ms_past_the_deadline=f"{asked.worst_ms:.0f}",
            reasons=asked.reported(),
            breaker_opened=times_opened,
            memory_MB=f"{grown_mb:+.1f}",
            by_the_LLM_when_well_again=f"{again.reasons['none']} of 90",
        )
        assert len(asked.late_ms) == DECISIONS
        assert asked.within(SLACK_MS) == 1.0, f"{asked.worst_ms:.0f} ms late"
        assert asked.reasons["none"] == 0
        assert (times_opened == 0) == (name in ANSWERED)
        assert again.reasons["none"] > 80, again.reported()
        assert grown_mb < 15


@contextmanager
def wrong_certificate() -> Iterator[str]:
    """Of an authority that nobody here knows."""
    authority = trustme.CA()
    certificate = authority.issue_cert("localhost")

    async def app(scope: object, receive: object, send: object) -> None:
        raise AssertionError("nobody gets here")

    config = uvicorn.Config(app, host="127.0.0.1", port=0, log_level="critical", lifespan="off")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    certificate.configure_cert(context)
    config.load()
    config.ssl = context
    config.load = lambda: None  # type: ignore[method-assign]
    with _served(config) as port:
        yield f"https://localhost:{port}/v1"


@contextmanager
def _served(config: uvicorn.Config) -> Iterator[int]:
    import threading
    import time

    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()[1]
    server.should_exit = True
    thread.join(timeout=10)


@contextmanager
def no_such_name() -> Iterator[str]:
    yield "http://no-such-host.invalid/v1"


@contextmanager
def nobody_listens() -> Iterator[str]:
    yield "http://127.0.0.1:9/v1"


UNREACHABLE: dict[str, Address] = {
    "wrong certificate": wrong_certificate,
    "DNS fails": no_such_name,
    "nobody listens": nobody_listens,
}


@pytest.mark.parametrize("name", UNREACHABLE)
def test_a_server_that_cannot_be_reached(name: str, report: Report, tables: Tables) -> None:
    with (
        UNREACHABLE[name]() as llm,
        serving_edge(AICVDS_LLM_URL=llm, AICVDS_MODE="llm", AICVDS_PLANNER="off") as (url, process),
        httpx.Client(base_url=url, timeout=10) as client,
    ):
        ask(url, report, 300, DEADLINE_MS)
        ready = wait_for(client, "unavailable")
        before_mb = resident_mb(process.pid)
        asked = ask(url, report, DECISIONS, DEADLINE_MS, first_step=100)
        grown_mb = resident_mb(process.pid) - before_mb
        tables.add(
            TITLE,
            fault=name,
            decisions=len(asked.late_ms),
            in_time=f"{asked.within(SLACK_MS):.1%}",
            latest_ms_past_the_deadline=f"{asked.worst_ms:.0f}",
            reasons=asked.reported(),
            breaker_opened="never ready",
            memory_MB=f"{grown_mb:+.1f}",
            by_the_LLM_when_well_again="",
        )
        assert ready["detail"]
        assert asked.within(SLACK_MS) == 1.0, f"{asked.worst_ms:.0f} ms late"
        assert asked.reasons == {"llm_unavailable": DECISIONS}
        assert grown_mb < 15
