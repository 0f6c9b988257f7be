"""Connections that move from one process of an edge to another, over real sockets."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from service.config.process_member import Member
from service.server.connection_handover import CONNECTION, MovableHttpProtocol, MovedConnections, Mover, request_bytes
from tests.support.waiting import PATIENCE_S

HERE, THERE = 0, 1
# More than a socket's buffer, and than a datagram, may have.
LARGE = bytes(range(256)) * 8000


async def _body(receive: Receive) -> bytes:
    body, more = b"", True
    while more:
        message = await receive()
        body, more = body + message.get("body", b""), message.get("more_body", False)
    return body


async def _answer(send: Send, status: int, body: bytes, *headers: tuple[bytes, bytes]) -> None:
    start = [(b"content-length", str(len(body)).encode()), *headers]
    await send({"type": "http.response.start", "status": status, "headers": start})
    await send({"type": "http.response.body", "body": body})


class Process:
    """What a process of the edge has, without the edge: requests for ``/there`` are the other's."""

    def __init__(self, slot: int, folder: Path) -> None:
        member = Member(slot, 2, folder)
        self.path = member.connections_of(slot)
        self.mover = Mover(member)
        self.slot = slot
        self.scopes: list[Scope] = []
        config = uvicorn.Config(self.app, interface="asgi3", log_level="error", ws="none")
        config.load()
        state = ServerState()
        self.protocol = partial(MovableHttpProtocol, config=config, server_state=state, app_state={})
        self.connections = state.connections

    async def app(self, scope: Scope, receive: Receive, send: Send) -> None:
        # The edge reads no body of a GET or a DELETE before it moves the connection.
        body = b"" if scope["path"] == "/early" else await _body(receive)
        owner = THERE if scope["path"] in ("/there", "/early") else HERE
        self.scopes.append(scope)
        if owner == self.slot:
            await _answer(send, 200, body, (b"x-process", str(self.slot).encode()))
            return
        connection: MovableHttpProtocol = scope[CONNECTION]
        if connection.movable and await self.mover.move(connection, owner, request_bytes(scope, body)):
            assert (await receive())["type"] == "http.disconnect"
        else:
            await _answer(send, 503, b"")


@asynccontextmanager
async def _edge(tmp_path: Path) -> AsyncIterator[tuple[str, list[Process], list[MovedConnections]]]:
    processes = [Process(slot, tmp_path) for slot in (HERE, THERE)]
    moved = [MovedConnections(process.path, process.protocol) for process in processes]
    server = await asyncio.get_running_loop().create_server(processes[HERE].protocol, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", processes, moved
    finally:
        server.close()
        for process, receiver in zip(processes, moved, strict=True):
            process.mover.close()
            receiver.close()
            for connection in list(process.connections):
                connection.transport.abort()
        await asyncio.sleep(0)


@pytest.fixture
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short path: a Unix socket's has at most 107 characters."""
    return tmp_path_factory.mktemp("m")


async def test_a_connection_goes_there_and_back(short: Path) -> None:
    async with _edge(short) as (url, processes, _), httpx.AsyncClient(base_url=url, timeout=PATIENCE_S) as client:
        answers = [await client.post(path, content=LARGE) for path in ("/here", "/there", "/there", "/here", "/there")]
        assert [a.headers["x-process"] for a in answers] == ["0", "1", "1", "0", "1"]
        assert all(a.content == LARGE for a in answers)
        # The second request there came on the same connection, without passing through the first process.
        assert [scope["path"] for scope in processes[HERE].scopes] == ["/here", "/there", "/here", "/there"]
        assert len({scope["client"] for process in processes for scope in process.scopes}) == 1
        assert sum(len(process.connections) for process in processes) == 1


async def test_the_request_arrives_as_it_was_sent(short: Path) -> None:
    async with _edge(short) as (url, processes, _), httpx.AsyncClient(base_url=url, timeout=PATIENCE_S) as client:
        headers = {"Authorization": "Bearer k", "Idempotency-Key": "i", "X-Twice": "1"}
        for body in (b"", b"sent", LARGE):
            for verb in ("POST", "PUT", "DELETE"):
                answer = await client.request(verb, "/there?a=%C3%BC&b", content=body, headers=headers)
                assert (answer.status_code, answer.content) == (200, body)
    for ours, theirs in zip(processes[HERE].scopes, processes[THERE].scopes, strict=False):
        for name in ("method", "path", "raw_path", "query_string", "http_version", "client", "scheme"):
            assert ours[name] == theirs[name]
        assert {field for field in ours["headers"] if field[0] != b"content-length"} <= set(theirs["headers"])


async def test_many_connections_move_at_once(short: Path) -> None:
    """More than the system queues in a datagram socket."""
    async with _edge(short) as (url, processes, _):
        limits = httpx.Limits(max_connections=60, max_keepalive_connections=60)
        async with httpx.AsyncClient(base_url=url, timeout=PATIENCE_S, limits=limits) as client:
            answers = await asyncio.gather(*(client.post("/there", content=b"x") for _ in range(60)))
            assert [a.headers.get("x-process") for a in answers] == ["1"] * 60
        assert len(processes[THERE].scopes) == 60


async def test_a_process_that_is_away_gets_nothing(short: Path) -> None:
    async with _edge(short) as (url, processes, moved), httpx.AsyncClient(base_url=url, timeout=PATIENCE_S) as client:
        moved[THERE].close()
        assert (await client.post("/there", content=b"x")).status_code == 503
        # The connection stays where it is.
        assert (await client.post("/here", content=b"x")).headers["x-process"] == "0"
        moved[THERE] = MovedConnections(processes[THERE].path, processes[THERE].protocol)
        assert (await client.post("/there", content=b"x")).headers["x-process"] == "1"


async def test_a_connection_with_a_second_request_waiting_does_not_move(short: Path) -> None:
    async with _edge(short) as (url, processes, _):
        host, port = url.removeprefix("http://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"GET /there HTTP/1.1\r\nhost: x\r\n\r\n" + b"GET /here HTTP/1.0\r\nhost: x\r\n\r\n")
        answers = await reader.read()
        writer.close()
        await writer.wait_closed()
    assert answers.count(b"HTTP/1.1 503") == 1 and answers.count(b"HTTP/1.1 200") == 1
    assert not processes[THERE].scopes


@pytest.mark.parametrize(
    "head",
    [b"GET /early HTTP/1.1\r\ncontent-length: %d", b"DELETE /early HTTP/1.1\r\ncontent-length: %d",
     b"GET /early HTTP/1.1\r\nx-length: %d\r\ntransfer-encoding: chunked"],
    ids=["get", "delete", "chunked"],
)  # fmt: skip
async def test_a_body_that_arrives_late_is_no_request_of_its_own(short: Path, head: bytes) -> None:
    body = b"DELETE /there HTTP/1.1\r\nhost: x\r\n\r\n"
    late = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body) if b"chunked" in head else body
    async with _edge(short) as (url, processes, _):
        host, port = url.removeprefix("http://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(head % len(body) + b"\r\nhost: x\r\n\r\n")
        answer = await reader.readuntil(b"\r\n\r\n")
        writer.write(late + b"GET /here HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n")
        answer += await reader.read()
        writer.close()
        await writer.wait_closed()
    assert answer.count(b"HTTP/1.1 503") == 1 and answer.count(b"HTTP/1.1 200") == 1
    assert [scope["path"] for scope in processes[HERE].scopes] == ["/early", "/here"]
    assert not processes[THERE].scopes


async def test_a_client_that_has_gone_leaves_nothing_behind(short: Path) -> None:
    async with _edge(short) as (_, processes, _):
        ours, theirs = socket.socketpair()
        theirs.close()
        transport: Any
        transport, protocol = await asyncio.get_running_loop().connect_accepted_socket(processes[HERE].protocol, ours)
        transport.abort()
        request = b"GET /there HTTP/1.1\r\n\r\n"
        assert await processes[HERE].mover.move(protocol, THERE, request)
        await asyncio.sleep(0.01)
        assert not processes[THERE].scopes


def test_a_request_is_written_with_its_whole_body() -> None:
    scope: dict[str, Any] = {
        "method": "POST",
        "raw_path": b"/decide",
        "query_string": b"",
        "http_version": "1.1",
        "headers": [(b"host", b"edge"), (b"content-length", b"7"), (b"expect", b"100-continue")],
    }
    assert request_bytes(scope, b"body") == b"POST /decide HTTP/1.1\r\nhost: edge\r\ncontent-length: 4\r\n\r\nbody"
