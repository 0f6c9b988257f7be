"""Heads of requests without end, against the server that flies: no key is asked before they end."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import httpx
import pytest
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from service.server import server
from tests.support.processes import serving_edge
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S

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
    pieces = piece * (server._MOST_BYTES // len(piece))
    return (begun + pieces)[: server._MOST_BYTES + 1] + ended


HOST = b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n"


@pytest.mark.parametrize(
    "head",
    [
        long(b"GET /", b"x"),
        long(HOST + b"x: ", b"y"),
        long(HOST, b"x: y\r\n"),
        # It could be answered.
        long(b"GET /healthz?" + b"x" * 100, b"x", b" HTTP/1.1\r\nhost: localhost\r\n\r\n"),
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
        (b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n", b"x: y\r\n" * 10_000),
        (b"POST /decide HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n0\r\n", b"x: y\r\n" * 10_000),
        (b"POST /decide HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n1;", b"e" * 60_000),
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
    monkeypatch.setattr(server, "MOST_S", 0.1)
    with serving(counting) as url:
        assert hung_up(address_of(url), sent)


@pytest.mark.parametrize("sent", [b"\r\n", b"GET / HT"])
def test_nor_does_it_help_to_have_asked_before(monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    with serving(counting) as url, socket.create_connection(address_of(url), timeout=PATIENCE_S) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nhost: localhost\r\n\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        monkeypatch.setattr(server, "MOST_S", 0.1)
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
        monkeypatch.setattr(server, "MOST_S", 0.1)
        # Who came later and said nothing was hung up before.
        assert hung_up(address_of(url), b"")
        may.set()
        assert waiting.result(timeout=PATIENCE_S).text == "alive"
