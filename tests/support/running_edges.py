"""What tests of running edges have in common."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from typing import Any

import httpx

Report = Callable[..., dict[str, Any]]


def drained(process: subprocess.Popen[str]) -> None:
    """Let nothing wait for a reader of its output from here on."""
    assert process.stdout is not None
    threading.Thread(target=process.stdout.read, daemon=True).start()


def first_event(client: httpx.Client, mission: str) -> str:
    """The first event of a mission's stream."""
    with client.stream("GET", f"/missions/{mission}/events") as stream:
        assert stream.status_code == 200
        return next(line for line in stream.iter_lines() if line.startswith("data:"))
