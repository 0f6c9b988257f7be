"""Priority of decisions over other requests: the embedded model has one slot."""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from service.llm.answers import Completion

# How often a request is cancelled for a decision, the quiet time that it waits for, and how long it waits at most. Each
# request evicts the other kind's prefix from the cache. In a mission, decisions come seconds apart.
_MOST_CANCELLATIONS = 3
_SILENCE_S = 0.5
_PATIENCE_S = 10.0


class DecisionPriority:
    """The decisions in progress at a server, and the background request that they may cancel."""

    def __init__(self) -> None:
        self._decisions = 0
        self._decided_at = -math.inf
        self._background: asyncio.Task[Completion] | None = None

    @contextmanager
    def decision(self) -> Iterator[None]:
        """The time of a request for a decision, which cancels the background request."""
        self._decisions += 1
        if self._background is not None:
            self._background.cancel()
        try:
            yield
        finally:
            self._decisions -= 1
            self._decided_at = time.monotonic()

    async def answer(self, ask: Callable[[], Awaitable[Completion]]) -> Completion:
        """The answer of a background request. Decisions cancel it up to three times; each time it starts again."""

        async def once() -> Completion:
            return await ask()

        for _ in range(_MOST_CANCELLATIONS):
            await self._await_silence()
            self._background = asyncio.create_task(once(), name="llm-rewriting")
            try:
                await asyncio.wait({self._background})
            finally:
                self._background.cancel()
            if not self._background.cancelled():
                return self._background.result()
        return await ask()

    async def _await_silence(self) -> None:
        """Wait until no decision has been requested for ``_SILENCE_S``, at most ``_PATIENCE_S``."""
        started = time.monotonic()
        while (now := time.monotonic()) < started + _PATIENCE_S:
            if not self._decisions and now - max(started, self._decided_at) >= _SILENCE_S:
                return
            await asyncio.sleep(min(0.1, _SILENCE_S))
