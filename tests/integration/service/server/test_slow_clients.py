"""Clients that do not take their answers, against real connections: they keep no request's place and fill no log."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from starlette.responses import FileResponse, PlainTextResponse, StreamingResponse
from starlette.types import Receive, Scope, Send

from service.api.request_limits import RequestLimits
from service.server import server
from service.server.server import BoundedHttpProtocol
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S, Gate, until

# More than the system keeps between the two ends.
LARGE = 16_000_000


def waits(client: socket.socket) -> None:
    """It only waits."""


class Connections:
    """What the server's connections have come to; a connection is stuck while bytes for its client are unsent."""

    def __init__(self) -> None:
        self.stuck = self.lost = 0


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> Connections:
    seen = Connections()
    pause, lose = BoundedHttpProtocol.pause_writing, BoundedHttpProtocol.connection_lost

    def pause_writing(self: BoundedHttpProtocol) -> None:
        seen.stuck += 1
        pause(self)

    def connection_lost(self: BoundedHttpProtocol, exc: Exception | None) -> None:
        lose(self, exc)
        seen.lost += 1

    monkeypatch.setattr(BoundedHttpProtocol, "pause_writing", pause_writing)
    monkeypatch.setattr(BoundedHttpProtocol, "connection_lost", connection_lost)
    return seen


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The lines of the log from now on, as the first ones of their minute."""
    written: list[str] = []
    for logger in (logging.getLogger("uvicorn.error"), server.log):
        monkeypatch.setattr(logger, "filters", [server.OncePerMinute()])
        monkeypatch.setattr(logger, "callHandlers", lambda record: written.append(record.getMessage()))
    return written


class App:
    """Answers of which a client may take its time, and a small one."""

    def __init__(self, path: Path) -> None:
        self._file = path / "large"
        self._file.write_bytes(bytes(LARGE))
        self.asked = self.ended = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        self.asked += 1
        try:
            match scope["path"]:
                case "/large":
                    await PlainTextResponse(bytes(LARGE))(scope, receive, send)
                case "/megabyte":
                    await PlainTextResponse(bytes(1_000_000))(scope, receive, send)
                case "/file":
                    await FileResponse(self._file)(scope, receive, send)
                case "/endless":
                    await StreamingResponse(self._endless())(scope, receive, send)
                case _:
                    await PlainTextResponse("small")(scope, receive, send)
        finally:
            self.ended += 1

    async def _endless(self) -> AsyncIterator[bytes]:
        while True:
            await asyncio.sleep(0)
            yield bytes(65536)


def connected(url: str, *sent: bytes) -> socket.socket:
    """A client that asks, and does not read."""
    parts = urlsplit(url)
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.settimeout(PATIENCE_S)
    client.connect((parts.hostname, parts.port))
    client.sendall(b"".join(sent))
    return client


def get(path: str, *headers: str) -> bytes:
    return "\r\n".join([f"GET {path} HTTP/1.1", "host: localhost", *headers, "", ""]).encode()


@pytest.mark.parametrize(
    ("sent", "then"),
    [
        (get("/large"), waits),
        (get("/file"), waits),
        (get("/file") * 10, waits),
        # A page's stream, for example.
        (get("/endless"), waits),
        # Only the answer's rest is left of a connection that the server closes.
        (get("/large", "connection: close"), waits),
        (get("/large"), lambda client: client.sendall(b"no request\r\n\r\n")),
        (get("/large"), lambda client: client.shutdown(socket.SHUT_WR)),
        (get("/endless"), lambda client: client.shutdown(socket.SHUT_WR)),
    ],
    ids=["whole", "file", "pipelined", "endless", "closed", "refused", "half-closed", "half-closed stream"],
)
def test_who_does_not_read_is_hung_up(
    tmp_path: Path,
    connections: Connections,
    lines: list[str],
    monkeypatch: pytest.MonkeyPatch,
    sent: bytes,
    then: Callable[[socket.socket], object],
) -> None:
    monkeypatch.setattr(server, "TAKEN_S", 0.5)
    app = App(tmp_path)
    with serving(app) as url, closing(connected(url, sent)) as client:
        until(lambda: connections.stuck)
        then(client)
        until(lambda: connections.lost)
        until(lambda: app.ended == app.asked)
    assert [line for line in lines if not line.startswith("Invalid")] == [
        "clients do not take their answers: their connections are closed"
    ]


def test_the_system_keeps_no_megabyte_for_who_does_not_read(tmp_path: Path, connections: Connections) -> None:
    with serving(App(tmp_path)) as url, closing(connected(url, get("/megabyte", "connection: close"))) as client:
        until(lambda: connections.stuck)
        answer = b"".join(iter(lambda: client.recv(65536), b""))
    assert len(answer.partition(b"\r\n\r\n")[2]) == 1_000_000


def test_who_reads_a_byte_at_a_time_is_hung_up(
    tmp_path: Path, connections: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "TAKEN_S", 0.1)
    with serving(App(tmp_path)) as url, closing(connected(url, get("/large"))) as client:
        until(lambda: client.recv(1) and connections.lost)


@pytest.mark.parametrize("path", ["/large", "/file"])
def test_who_reads_slowly_gets_the_whole_answer(
    tmp_path: Path, connections: Connections, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    # The time is over at once, again and again, and what was taken meanwhile is enough.
    monkeypatch.setattr(server, "TAKEN_S", 0.001)
    monkeypatch.setattr(server, "TAKEN_BYTES", 0)
    with serving(App(tmp_path)) as url, closing(connected(url, get(path, "connection: close"))) as client:
        until(lambda: connections.stuck)
        answer = b"".join(iter(lambda: client.recv(65536), b""))
    assert len(answer.partition(b"\r\n\r\n")[2]) == LARGE


@pytest.mark.parametrize("path", ["/large", "/file", "/endless"])
def test_clients_that_do_not_read_take_nobodys_place(tmp_path: Path, connections: Connections, path: str) -> None:
    with serving(RequestLimits(App(tmp_path), most=2, limit=1000)) as url, ExitStack() as held:
        for number in range(1, 5):
            held.enter_context(closing(connected(url, get(path) * 3)))
            until(lambda number=number: connections.stuck >= number)  # type: ignore[misc]
        assert httpx.get(f"{url}/small", timeout=PATIENCE_S).text == "small"


@pytest.mark.parametrize("path", ["/large", "/file", "/endless"])
def test_clients_that_close_write_no_line(
    tmp_path: Path, connections: Connections, lines: list[str], path: str
) -> None:
    app = App(tmp_path)
    with serving(app) as url, ExitStack() as held:
        for number in range(1, 5):
            held.enter_context(closing(connected(url, get(path) * 3)))
            until(lambda number=number: connections.stuck >= number)  # type: ignore[misc]
        held.close()
        until(lambda: connections.lost == 4)
        until(lambda: app.ended == app.asked)
    assert [line for line in lines if "Exception" in line or "clients" in line] == []


def test_a_stream_ends_with_its_client_though_another_request_waits() -> None:
    left = threading.Event()

    async def quiet(scope: Scope, receive: Receive, send: Send) -> None:
        assert scope["type"] == "http"
        await receive()
        if (await receive())["type"] == "http.disconnect":
            left.set()

    with serving(quiet) as url:
        connected(url, get("/events") + get("/events")).close()
        assert left.wait(PATIENCE_S)


def test_many_requests_do_not_wait_in_one_connection(connections: Connections) -> None:
    came: list[str] = []

    async def patient(scope: Scope, receive: Receive, send: Send) -> None:
        assert scope["type"] == "http"
        came.append(scope["path"])
        await gate.passed()
        await PlainTextResponse("small")(scope, receive, send)

    with Gate() as gate, serving(patient) as url:
        few = connected(url, get("/few") * 10 + get("/few", "connection: close"))
        with closing(connected(url, get("/many") * 1000)):
            until(lambda: connections.lost == 1)
        gate.open()
        with closing(few):
            assert b"".join(iter(lambda: few.recv(65536), b"")).count(b"HTTP/1.1 200 ") == 11
    assert came.count("/many") == 1


def test_what_any_client_may_say_is_one_line_a_minute(lines: list[str]) -> None:
    async def unused(scope: Scope, receive: Receive, send: Send) -> None:
        raise AssertionError(scope)

    with serving(unused) as url:
        for _ in range(20):
            with closing(connected(url, b"no request\r\n\r\n")) as client:
                assert b"".join(iter(lambda: client.recv(65536), b"")).startswith(b"HTTP/1.1 400 ")
    assert lines.count("Invalid HTTP request received.") == 1
