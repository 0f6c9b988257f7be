"""The limits of queries to the LLM: late answers are refused, and so are queries when too many are waiting."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable

from service.deciding.stopwatch import Deadline
from service.llm.answers import Completion, NoDecision

# The most that a query may take after SIGTERM, so that every UAV is answered before the process is killed.
_CLOSING_S = 4.0


class QueryLimits:
    """Bounds the queries to the LLM in number and in time.

    Args:
        most: the largest number of waiting queries.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._waiting: set[asyncio.Timeout] = set()
        self._closing = False

    def hurry(self) -> None:
        """Shorten the limits because the service is closing: a waiting query gets a few more seconds."""
        self._closing = True
        ends = asyncio.get_running_loop().time() + _CLOSING_S
        for limit in self._waiting:
            # A limit that has just expired cannot be changed.
            if not limit.expired():
                limit.reschedule(min(limit.when() or ends, ends))

    async def within(self, query: Callable[[], Awaitable[Completion]], deadline: Deadline) -> Completion:
        """The query's answer; raises ``NoDecision`` after the deadline, or if too many queries are waiting."""
        if len(self._waiting) >= self._most:
            raise NoDecision("llm_busy", f"{self._most} decisions wait for it already")
        limit = asyncio.timeout(min(deadline.left(), _CLOSING_S if self._closing else math.inf))
        try:
            async with limit:
                self._waiting.add(limit)
                return await query()
        except TimeoutError:
            raise NoDecision("llm_timeout", "no answer within the deadline") from None
        finally:
            self._waiting.discard(limit)
