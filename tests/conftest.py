"""Fixtures shared by every test."""

from __future__ import annotations

import gc
import itertools
import os
import secrets
import shutil
import signal
import ssl
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import hypothesis
import pytest
import torch

from service.api.app import create_app
from service.config.settings import Settings
from service.prompting.tokenizer import encoding
from tests.support.running import serving
from tests.support.storing import StoreHere
from tests.support.waiting import PATIENCE_S

# An edge started as a process has no store unless a test gives one: otherwise all would share the user's store.
os.environ["AICVDS_STORE"] = "none"

# Ray reads its token when it is imported, and TorchRL imports it: one token for all tests, before any of them.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}

# A shell starts `make test &` with SIGINT ignored, and every process of a test would inherit that and outlive Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Pytest's workers already take every core.
torch.set_num_threads(1)
# A busy machine makes no example wrong.
hypothesis.settings.register_profile("tests", deadline=None)
hypothesis.settings.load_profile("tests")

# Set where the tests must be complete, as in CI: a test whose program is missing then fails.
_COMPLETE = "TESTS_COMPLETE"
# Programs from Debian's packages of the same names; the mark `needs` names a test's program.
_PROGRAMS = ("chromium", "haproxy", "mosquitto", "pgbouncer", "prometheus")

Edge = Callable[..., httpx.Client]

# Imports make millions of objects and no garbage: to look through them again and again takes seconds of the collection,
# and of the tests, which are started without them.
gc.disable()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an answer wait for a slow disk as long as necessary, unless a test sets another limit.

    So long an edge waits for the end of the process that writes its store, too. One that outlives its edge is a
    ResourceWarning, and fails whatever test runs then.
    """
    monkeypatch.setattr("service.edge.engine.STORE_S", PATIENCE_S)
    monkeypatch.setattr("service.storage.process_writer.EXIT_S", PATIENCE_S)


@pytest.fixture(autouse=True, scope="session")
def vocabulary() -> Iterator[None]:
    """One token vocabulary for all edges of this process: to build one takes more than most tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.prompting.token_accounting.encoding", cache(encoding))
        yield


@pytest.fixture(autouse=True, scope="session")
def certificates() -> Iterator[None]:
    """One SSL context for all HTTP clients of this process: to read the certificates takes more than most requests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ssl, "create_default_context", cache(ssl.create_default_context))
        yield


@pytest.fixture(scope="module")
def made_on_decide() -> Iterator[None]:
    """Edges that make a test's missions on their first decision."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AICVDS_CREATE_ON_DECIDE", "on")
        yield


@pytest.fixture
def edge(tmp_path: Path) -> Iterator[Edge]:
    """Starts real edges with stores and the given settings (by default no LLM), and returns a client of each.

    The default deadline is long, so that a busy machine changes no decision.
    """
    count = itertools.count()
    with ExitStack() as stack:

        def start(**settings: Any) -> httpx.Client:
            store = StoreHere(tmp_path / f"missions-{next(count)}.db")
            url = stack.enter_context(
                serving(create_app(Settings(**{"mode": "value", "deadline_ms": 60_000, **settings}), store))
            )
            return stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S))

        yield start


@pytest.fixture
def report() -> Callable[..., dict[str, Any]]:
    """Makes the body of a valid ``/decide``: four sensors heard at ``step`` and one never heard."""

    def make(**changes: Any) -> dict[str, Any]:
        step = changes.get("step", 0)
        body: dict[str, Any] = {
            "mission_id": "test",
            "uav_id": 0,
            "step": step,
            "position": [500.0, 450.0],
            "sensors": {
                "id": [0, 1, 2, 3, 4],
                "x": [420.0, 650.0, 300.0, 520.0, 900.0],
                "y": [380.0, 520.0, 700.0, 500.0, 100.0],
                "queue": [52, 17, 33, 8, None],
                "battery": [49.0, 50.0, 47.5, 50.0, None],
                "channel_gain": [-83.1, -96.0, -109.2, -81.0, None],
                "last_seen": [step, step, step, step, None],
            },
        }
        return {**body, **changes}

    return make


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests that need a missing program, unless the tests must be complete."""
    missing = set(_missing())
    left_out = [i for i in items if missing & {name for mark in i.iter_markers("needs") for name in mark.args}]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_collection_finish() -> None:
    """Leave all that was imported out of every later search for garbage."""
    gc.freeze()
    gc.enable()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the deselected tests' programs, and how to install them."""
    for name in _missing():
        terminalreporter.write_line(f"left out: the tests that need {name}. To run them: apt-get install {name}")


def _missing() -> list[str]:
    return [] if os.environ.get(_COMPLETE) else [name for name in _PROGRAMS if shutil.which(name) is None]
