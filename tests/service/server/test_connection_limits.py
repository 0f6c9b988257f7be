"""Heads of requests without end, against the server that flies: no key is asked before they end."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from urllib.parse import urlsplit

import httpx
import pytest
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from service.server import connection_limits
from tests.e2e.processes import serving_edge
from tests.running import serving
from tests.waiting import PATIENCE_S, until

Address = tuple[str, int]
# More than the system keeps between the two ends.
_MOST_SENT = 64_000_000


def address_of(url: str) -> Address:
    parts = urlsplit(url)
    return parts.hostname or "", parts.port or 0


@pytest.fixture(scope="module")
def edge_process() -> Iterator[str]:
    """``aicvds serve`` as it is started; that it has not loaded yet does not matter here."""
    with serving_edge(AICVDS_MODE="policy") as (url, _):
        yield url


def answered(address: Address, sent: bytes) -> bytes:
    """All that comes back until the server hangs up."""
    with socket.create_connection(address, timeout=PATIENCE_S) as connection:
        connection.sendall(sent)
        return b"".join(iter(lambda: connection.recv(65536), b""))


def hung_up(address: Address, sent: bytes) -> bool:
    """Whether nothing comes back: what is sent may come too late to be read."""
    try:
        return answered(address, sent) == b""
    except ConnectionError:
        return True


def long(begun: bytes, piece: bytes, ended: bytes = b"") -> bytes:
    """A head of a byte more than is taken: nothing of it is on its way when it is refused, and the answer arrives."""
    pieces = piece * (connection_limits._MOST_BYTES // len(piece))
    return (begun + pieces)[: connection_limits._MOST_BYTES + 1] + ended


HOST = b"GET /healthz HTTP/1.1\r\nhost: x\r\n"


@pytest.mark.parametrize(
    "head",
    [
        long(b"GET /", b"x"),
        long(HOST + b"x: ", b"y"),
        long(HOST, b"x: y\r\n"),
        # It could be answered.
        long(b"GET /healthz?" + b"x" * 100, b"x", b" HTTP/1.1\r\nhost: x\r\n\r\n"),
    ],
    ids=["address", "one header", "many headers", "complete"],
)
def test_a_head_past_64_kilobytes_is_refused(edge_process: str, head: bytes) -> None:
    answer = answered(address_of(edge_process), head)
    assert answer.startswith(b"HTTP/1.1 431 ")
    assert b"\r\ncontent-type: application/problem+json\r\n" in answer
    assert httpx.get(f"{edge_process}/healthz", headers={"x": "y" * 60_000}, timeout=PATIENCE_S).status_code == 200


@pytest.mark.parametrize(
    ("begun", "more"),
    [
        (b"GET /healthz HTTP/1.1\r\nhost: x\r\n", b"x: y\r\n" * 10_000),
        (b"POST /decide HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n0\r\n", b"x: y\r\n" * 10_000),
        (b"POST /decide HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n1;", b"e" * 60_000),
    ],
    ids=["headers", "trailers", "extension of a chunk"],
)
def test_who_goes_on_without_end_is_hung_up(edge_process: str, begun: bytes, more: bytes) -> None:
    with socket.create_connection(address_of(edge_process), timeout=PATIENCE_S) as connection:
        connection.sendall(begun)
        with pytest.raises(ConnectionError):
            for _ in range(_MOST_SENT // len(more)):
                connection.sendall(more)


async def counting(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers how many bytes the body has."""
    assert scope["type"] == "http"
    size, more = 0, True
    while more:
        message = await receive()
        size, more = size + len(message["body"]), message["more_body"]
    await PlainTextResponse(str(size))(scope, receive, send)


def test_a_body_in_many_small_chunks_is_no_head() -> None:
    with serving(counting) as url:
        assert httpx.post(url, content=(b"x" for _ in range(30_000)), timeout=PATIENCE_S).text == "30000"


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nho"])
def test_who_does_not_end_its_head_is_hung_up(monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    monkeypatch.setattr(connection_limits, "_MOST_S", 0.1)
    with serving(counting) as url:
        assert hung_up(address_of(url), sent)


@pytest.mark.parametrize("sent", [b"\r\n", b"GET / HT"])
def test_nor_does_it_help_to_have_asked_before(monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    with serving(counting) as url, socket.create_connection(address_of(url), timeout=PATIENCE_S) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nhost: x\r\n\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        monkeypatch.setattr(connection_limits, "_MOST_S", 0.1)
        # Whatever comes ends uvicorn's own waiting.
        connection.sendall(sent)
        while connection.recv(65536):
            pass


def test_who_has_asked_may_wait_longer_than_that(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, may = threading.Event(), threading.Event()

    async def patient(scope: Scope, receive: Receive, send: Send) -> None:
        assert scope["type"] == "http"
        asked.set()
        await asyncio.to_thread(may.wait, PATIENCE_S)
        await PlainTextResponse("alive")(scope, receive, send)

    with serving(patient) as url, ThreadPoolExecutor() as pool:
        waiting = pool.submit(httpx.get, url, timeout=PATIENCE_S)
        assert asked.wait(PATIENCE_S)
        monkeypatch.setattr(connection_limits, "_MOST_S", 0.1)
        # Who came later and said nothing was hung up before.
        assert hung_up(address_of(url), b"")
        may.set()
        assert waiting.result(timeout=PATIENCE_S).text == "alive"


LARGE = b"x" * 4_000_000


async def disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


class Answering:
    """An application with a large answer, a small one and an endless stream, that counts the requests in progress."""

    def __init__(self) -> None:
        self.running = 0
        self.begun = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        assert scope["type"] == "http"
        self.running, self.begun = self.running + 1, self.begun + 1
        try:
            await send({"type": "http.response.start", "status": 200, "headers": []})
            if scope["path"] == "/stream":
                gone = asyncio.create_task(disconnected(receive))
                while not gone.done():
                    await send({"type": "http.response.body", "body": LARGE[:65536], "more_body": True})
                    await asyncio.sleep(0)
                return
            for start in range(0, len(LARGE) if scope["path"] == "/large" else 1, 65536):
                await send({"type": "http.response.body", "body": LARGE[start : start + 65536], "more_body": True})
            await send({"type": "http.response.body", "body": b""})
        finally:
            self.running -= 1


def unread(address: Address, sent: bytes) -> socket.socket:
    """A connection that has sent something and reads nothing of the answers."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.settimeout(PATIENCE_S)
    connection.connect(address)
    connection.sendall(sent)
    return connection


@pytest.mark.parametrize("path", ["/large", "/stream"])
@pytest.mark.parametrize("requests", [1, 50], ids=["one", "pipelined"])
def test_who_does_not_read_is_cut_off(monkeypatch: pytest.MonkeyPatch, path: str, requests: int) -> None:
    monkeypatch.setattr(connection_limits, "_READ_S", 0.2)
    app = Answering()
    with serving(app) as url, unread(address_of(url), b"GET %s HTTP/1.1\r\n\r\n" % path.encode() * requests) as one:
        until(lambda: app.begun > 0 and not app.running)
        # uvicorn would begin the next of them, and wait for the client again.
        assert app.begun == 1
        with suppress(ConnectionError):
            read = 0
            while some := one.recv(1_000_000):
                read += len(some)
            assert read < len(LARGE)
        assert httpx.get(url, timeout=PATIENCE_S).status_code == 200


def test_who_reads_a_byte_now_and_then_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_limits, "_READ_S", 0.2)
    app = Answering()
    with serving(app) as url, unread(address_of(url), b"GET /large HTTP/1.1\r\n\r\n") as one:

        def dripped() -> bool:
            one.recv(1)
            return app.begun > 0 and not app.running

        with suppress(ConnectionError):
            until(dripped)
        until(lambda: not app.running)


def test_a_closed_connection_does_not_wait_for_its_client_for_ever(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Small answers that fill no buffer: each is complete, and the connection ends after them."""
    monkeypatch.setattr(connection_limits, "_READ_S", 0.2)
    monkeypatch.setattr(connection_limits.BoundedHttpProtocol, "_quiet_until", {})
    app = Answering()
    head = b"GET / HTTP/1.1\r\nx: " + b"y" * 50 + b"\r\n\r\n"
    with serving(app) as url:
        ones = [unread(address_of(url), head * 40_000) for _ in range(2)]
        until(lambda: sum("does not read" in line.message for line in caplog.records) == 1)
        for one in ones:
            with suppress(ConnectionError):
                while one.recv(1_000_000):
                    pass
            one.close()
        until(lambda: not app.running)
    assert sum("does not read" in line.message for line in caplog.records) == 1


def test_who_reads_slowly_gets_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_limits, "_READ_S", 1.0)
    app = Answering()
    with serving(app) as url, unread(address_of(url), b"GET /large HTTP/1.0\r\n\r\n") as one:
        read = 0
        while some := one.recv(2048):
            read += len(some)
    assert read > len(LARGE)


def test_who_leaves_amid_an_answer_leaves_no_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    app = Answering()
    with serving(app) as url:
        for sent in (
            b"GET /large HTTP/1.1\r\n\r\n" * 50,
            b"GET /stream HTTP/1.1\r\n\r\n",
            b"GET /large HTTP/1.1\r\n\r\nnonsense",
        ):
            with unread(address_of(url), sent) as one:
                one.recv(1)
            until(lambda: not app.running)
    assert [line.message for line in caplog.records if line.name == "asyncio"] == []
