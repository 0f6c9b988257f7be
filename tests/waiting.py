"""Waiting without a clock: for what must come true, and at gates that a test opens."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TypeVar

T = TypeVar("T")

# Far beyond what a busy machine needs: it is only waited out by a test that fails.
PATIENCE_S = 120.0


def until(found: Callable[[], T], told: Callable[[], object] = lambda: "") -> T:
    """What ``found`` returns, as soon as that is true; ``told`` says how it stood where it never is."""
    ends = time.monotonic() + PATIENCE_S
    while not (seen := found()):
        assert time.monotonic() < ends, f"it never came true: {told()}"
        time.sleep(0.005)
    return seen


async def soon(found: Callable[[], T]) -> T:
    """As :func:`until`, for a condition of this event loop."""
    async with asyncio.timeout(PATIENCE_S):
        while not (seen := found()):
            await asyncio.sleep(0.001)
    return seen


class Gate:
    """Holds whoever comes until it is opened, from any thread; at the end of a ``with`` it is.

    ``came`` counts those who have come, whether they have passed or not.
    """

    def __init__(self, *, opened: bool = False) -> None:
        self._opened = threading.Event()
        self._counting = threading.Lock()
        self.came = 0
        if opened:
            self._opened.set()

    def open(self) -> None:
        """Let everyone pass who is here, or comes."""
        self._opened.set()

    def shut(self) -> None:
        """Hold who comes from now on."""
        self._opened.clear()

    def wait(self) -> None:
        """Pass, in a thread."""
        self._come()
        assert self._opened.wait(PATIENCE_S)

    async def passed(self) -> None:
        """Pass, on an event loop."""
        self._come()
        while not self._opened.is_set():
            await asyncio.sleep(0.002)

    def _come(self) -> None:
        with self._counting:
            self.came += 1

    def __enter__(self) -> Gate:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.open()


class Clock:
    """Stands in for a module's ``time``: ahead of the real one by as much as a test says."""

    def __init__(self) -> None:
        self.ahead_s = 0.0

    def perf_counter(self) -> float:
        return time.perf_counter() + self.ahead_s

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s


class Striding:
    """Stands in for a module's ``time``: stands still, but for a stride at each look."""

    def __init__(self, stride_s: float) -> None:
        self.now_s, self._stride_s = 1000.0, stride_s

    def monotonic(self) -> float:
        self.now_s += self._stride_s
        return self.now_s
