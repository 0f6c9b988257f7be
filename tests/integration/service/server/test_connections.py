"""Connections without end, against the server that flies: those that there are, and the store, go on."""

from __future__ import annotations

import resource
import socket
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from service.server import server
from tests.support.processes import serving_edge
from tests.support.stored_missions import stored_decision
from tests.support.waiting import PATIENCE_S, until

LEAST = 16


def hung_up(connection: socket.socket) -> bool:
    """Whether the server closed it, or reset it."""
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def answers(url: str) -> bool:
    """Whether the server takes another connection."""
    try:
        return httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
    except httpx.TransportError:
        return False


def test_those_that_there_are_go_on(tmp_path: Path, report: Callable[..., dict[str, Any]]) -> None:
    with (
        serving_edge(AICVDS_MODE="value", AICVDS_STORE=str(tmp_path / "m.db")) as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as uav,
        ExitStack() as crowd,
    ):
        uav.get("/readyz").raise_for_status()
        files = server._OTHER_FILES + LEAST
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (files, files))
        address = urlsplit(url)
        host, port = address.hostname or "", address.port or 0
        idle = [
            crowd.enter_context(socket.create_connection((host, port), timeout=PATIENCE_S)) for _ in range(3 * LEAST)
        ]
        assert hung_up(idle[-1])
        # One of those that came before is served still.
        idle[0].sendall(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n")
        assert idle[0].recv(65536).startswith(b"HTTP/1.1 200 ")
        for step in range(3):
            stored_decision(uav, report(step=step))
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{url}/healthz", timeout=PATIENCE_S)
        crowd.close()
        until(lambda: answers(url))
