"""Waiting for a condition, and at gates that a test opens."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TypeVar

T = TypeVar("T")

# Long enough for a busy machine: only a failing test waits so long.
PATIENCE_S = 120.0


def until(condition: Callable[[], T], describe: Callable[[], object] = lambda: "") -> T:
    """Wait until ``condition`` returns a true value, and return it; ``describe`` gives the state after a timeout."""
    ends = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < ends, f"it never came true: {describe()}"
        time.sleep(0.005)
    return value


async def soon(condition: Callable[[], T]) -> T:
    """As :func:`until`, for a condition on this event loop."""
    async with asyncio.timeout(PATIENCE_S):
        while not (value := condition()):
            await asyncio.sleep(0.001)
    return value


class Gate:
    """Holds every caller until it is opened, from any thread. The end of a ``with`` opens it.

    ``callers`` counts the callers, whether they have passed or not.
    """

    def __init__(self, *, opened: bool = False) -> None:
        self._opened = threading.Event()
        self._counting = threading.Lock()
        self.callers = 0
        if opened:
            self._opened.set()

    def open(self) -> None:
        """Let all present and future callers pass."""
        self._opened.set()

    def shut(self) -> None:
        """Hold future callers."""
        self._opened.clear()

    def wait(self) -> None:
        """Wait for the gate in a thread."""
        self._count_caller()
        assert self._opened.wait(PATIENCE_S)

    async def passed(self) -> None:
        """Wait for the gate on an event loop."""
        self._count_caller()
        while not self._opened.is_set():
            await asyncio.sleep(0.002)

    def _count_caller(self) -> None:
        with self._counting:
            self.callers += 1

    def __enter__(self) -> Gate:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.open()


class Clock:
    """Replaces a module's ``time``: it is ``ahead_s`` ahead of the real one."""

    def __init__(self) -> None:
        self.ahead_s = 0.0

    def perf_counter(self) -> float:
        return time.perf_counter() + self.ahead_s

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s

    def time(self) -> float:
        return time.time() + self.ahead_s


class Striding:
    """Replaces a module's ``time``: it advances only by a stride at each call."""

    def __init__(self, stride_s: float) -> None:
        self.now_s, self._stride_s = 1000.0, stride_s

    def monotonic(self) -> float:
        self.now_s += self._stride_s
        return self.now_s
