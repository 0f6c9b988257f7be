"""Support for tests of running edges."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from typing import Any

import httpx

Report = Callable[..., dict[str, Any]]


def drain_output(process: subprocess.Popen[str]) -> None:
    """Read the rest of the output in a thread, so that the process never waits for a reader."""
    assert process.stdout is not None
    threading.Thread(target=process.stdout.read, daemon=True).start()


def first_event(client: httpx.Client, mission: str) -> str:
    """The first event of a mission's stream."""
    with client.stream("GET", f"/missions/{mission}/events") as stream:
        assert stream.status_code == 200
        return next(line for line in stream.iter_lines() if line.startswith("data:"))
