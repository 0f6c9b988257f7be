"""Connections without end, against the server that flies: those that there are, and the store, go on."""

from __future__ import annotations

import resource
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from service.server import connection_limits
from tests.e2e.processes import serving_edge

LEAST = 16


def hung_up(connection: socket.socket) -> bool:
    """Whether the server closed it, or reset it, within a second."""
    connection.settimeout(1)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_those_that_there_are_go_on(tmp_path: Path, report: Callable[..., dict[str, Any]]) -> None:
    with (
        serving_edge(AICVDS_MODE="value", AICVDS_STORE=str(tmp_path / "m.db")) as (url, process),
        httpx.Client(base_url=url, timeout=60) as uav,
        ExitStack() as crowd,
    ):
        uav.get("/readyz").raise_for_status()
        files = connection_limits._OTHER_FILES + LEAST
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (files, files))
        address = urlsplit(url)
        host, port = address.hostname or "", address.port or 0
        idle = [crowd.enter_context(socket.create_connection((host, port), timeout=60)) for _ in range(3 * LEAST)]
        assert not hung_up(idle[0])
        assert hung_up(idle[-1])
        for step in range(3):
            answer = uav.post("/decide", json=report(step=step))
            assert (answer.status_code, answer.json()["stored"]) == (200, True)
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{url}/healthz", timeout=60)
        crowd.close()
        ends = time.monotonic() + 30
        while True:
            try:
                assert httpx.get(f"{url}/healthz", timeout=60).status_code == 200
                break
            except httpx.TransportError:
                assert time.monotonic() < ends
