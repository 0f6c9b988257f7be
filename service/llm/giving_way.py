"""What is asked beside decisions gives way to them: the embedded model has one slot."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from service.llm.answers import Completion

# It gives way so often, and waits so long at most for so much time without decisions: each spoils the other's prefix
# cache. In a mission, decisions come seconds apart.
_STEPS_BACK = 3
_SILENCE_S = 0.5
_PATIENCE_S = 10.0


class GivingWay:
    """The decisions under way at a server, and the call beside them."""

    def __init__(self) -> None:
        self._decisions = 0
        self._decided_at = -math.inf
        self._beside: asyncio.Task[Completion] | None = None

    @contextmanager
    def decision(self) -> Iterator[None]:
        """While a decision is asked for; gives up the call beside."""
        self._decisions += 1
        if self._beside is not None:
            self._beside.cancel()
        try:
            yield
        finally:
            self._decisions -= 1
            self._decided_at = time.monotonic()

    async def answer(self, ask: Callable[[], Awaitable[Completion]]) -> Completion:
        """The answer of a call beside, which a few times is given up for a decision and begins again."""

        async def once() -> Completion:
            return await ask()

        for _ in range(_STEPS_BACK):
            await self._await_silence()
            self._beside = asyncio.create_task(once(), name="llm-rewriting")
            try:
                await asyncio.wait({self._beside})
            finally:
                self._beside.cancel()
            if not self._beside.cancelled():
                return self._beside.result()
        return await ask()

    async def _await_silence(self) -> None:
        """Wait until no decision has been asked for a while, but not longer than ``_PATIENCE_S``."""
        begun = time.monotonic()
        while (now := time.monotonic()) < begun + _PATIENCE_S:
            if not self._decisions and now - max(begun, self._decided_at) >= _SILENCE_S:
                return
            await asyncio.sleep(min(0.1, _SILENCE_S))
