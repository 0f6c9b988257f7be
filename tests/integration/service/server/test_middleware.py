"""The edge while it loads: it says that it lives; whatever else is asked waits, and is answered rather than refused."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import httpx
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from service.api.app import create_app
from service.config.settings import Settings
from service.server.middleware import StartupGate
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S, Gate, until


class Arrivals:
    """An ASGI application that passes requests on to the gate, and has their paths and the server's event loop."""

    def __init__(self, gate: StartupGate) -> None:
        self.gate = gate
        self.paths: set[str] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.loop = asyncio.get_running_loop()
        self.paths.add(scope.get("path", ""))
        await self.gate(scope, receive, send)


@contextmanager
def loading(make: Callable[[], FastAPI]) -> Iterator[tuple[str, Arrivals, Gate, threading.Event]]:
    """An edge that loads only once a gate is open: its URL, its requests, that gate, and the event of its end."""
    may, stopped = Gate(), threading.Event()

    def load() -> FastAPI:
        may.wait()
        return make()

    arrivals = Arrivals(StartupGate(load, stopped.set))
    # The server's end waits for the loading.
    with serving(arrivals) as url, may:
        yield url, arrivals, may, stopped


def test_alive_is_told_and_a_decision_waits_until_it_is_loaded(
    report: Callable[..., dict[str, Any]],
) -> None:
    with (
        loading(lambda: create_app(Settings(mode="policy"))) as (url, arrivals, may, _),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
        ThreadPoolExecutor() as pool,
    ):
        asked = pool.submit(httpx.post, f"{url}/decide", json=report(), timeout=PATIENCE_S)
        ready = pool.submit(httpx.get, f"{url}/readyz", timeout=PATIENCE_S)
        early = client.get("/healthz")
        until(lambda: arrivals.paths >= {"/decide", "/readyz"})
        assert not asked.done()
        assert not ready.done()
        may.open()
        answer = asked.result(timeout=PATIENCE_S)
        assert (answer.status_code, answer.json()["source"]) == (200, "policy")
        assert ready.result(timeout=PATIENCE_S).json()["llm"] == "off"
        late = client.get("/healthz")
    assert (early.status_code, early.json()) == (late.status_code, late.json()) == (200, {"status": "ok"})
    # The same headers too, the time apart: nobody can tell the two from each other.
    assert {**early.headers, "date": ""} == {**late.headers, "date": ""}
    assert early.headers["x-frame-options"] == "DENY"


def test_only_a_plain_question_after_its_life_is_answered_early() -> None:
    with (
        loading(lambda: create_app(Settings(mode="policy"))) as (url, _, may, _),
        ThreadPoolExecutor() as pool,
    ):
        posted = pool.submit(httpx.post, f"{url}/healthz", timeout=PATIENCE_S)
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
        assert not posted.done()
        may.open()
        assert posted.result(timeout=PATIENCE_S).status_code == 405


def test_what_cannot_be_loaded_ends_the_server_and_leaves_nobody_waiting() -> None:
    def broken() -> FastAPI:
        raise RuntimeError("no such module")

    with loading(broken) as (url, arrivals, may, stopped), ThreadPoolExecutor() as pool:
        asked = pool.submit(httpx.get, f"{url}/readyz", timeout=PATIENCE_S)
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
        may.open()
        answer = asked.result(timeout=PATIENCE_S)
        assert stopped.wait(timeout=PATIENCE_S)
        assert str(arrivals.gate.error) == "no such module"
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 503
    assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")


def test_nobody_waits_for_an_edge_that_ends() -> None:
    with (
        loading(lambda: create_app(Settings(mode="policy"))) as (url, arrivals, _, _),
        ThreadPoolExecutor() as pool,
    ):
        asked = pool.submit(httpx.get, f"{url}/readyz", timeout=PATIENCE_S)
        until(lambda: "/readyz" in arrivals.paths)
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
        assert not asked.done()
        arrivals.loop.call_soon_threadsafe(arrivals.gate.open)
        answer = asked.result(timeout=PATIENCE_S)
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")


def test_nothing_slow_is_imported_before_the_first_answer() -> None:
    slow = ("torch", "numpy", "scipy", "fastapi", "sqlalchemy", "alembic", "ortools", "tiktoken", "xllamacpp")
    reported = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, uvicorn, service.commands.serve, service.config.settings\n"
            "import service.observability.logs, service.server.middleware\n"
            f"print([name for name in {slow} if name in sys.modules])",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert reported.stdout.strip() == "[]"
