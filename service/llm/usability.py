"""Whether an LLM server is called: whether it answers, and usably; a healthy server may give only unusable answers."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from contextvars import Context

from service.llm.answers import NoDecision

_FAILURES = 3
PAUSE_S, LONGEST_PAUSE_S = 5.0, 60.0
log = logging.getLogger(__name__)
# Answers in a row that cannot be used. A small model errs now and then.
_DEGRADED = 5
_MOST_QUOTED = 200
# Until a degraded server is probed.
FIRST_UNUSABLE_S, _LONGEST_UNUSABLE_S = 30.0, 480.0


class CircuitBreaker:
    """Counts the failures of one LLM.

    Attributes:
        troubled: whether there was a failure since the last answer.
    """

    def __init__(self) -> None:
        self._failures = 0
        self._openings = 0
        self.troubled = False

    def answered(self) -> None:
        """Count an answer."""
        self._failures = self._openings = 0
        self.troubled = False

    def failed(self) -> bool:
        """Count a failure; returns whether it opens the breaker."""
        self.troubled = True
        self._failures += 1
        if self._failures < (1 if self._openings else _FAILURES):
            return False
        self._failures = 0
        self._openings += 1
        return True

    @property
    def pause_s(self) -> float:
        """Seconds from the opening to the next probe."""
        return min(LONGEST_PAUSE_S, PAUSE_S * 2.0 ** min(self._openings - 1, 10))


class SilenceCounter:
    """Adds up the time that calls waited without an answer; enough of it without an answer in between is one failure.

    A call cancelled early by a short deadline counts for the time that it waited. Time in which several calls waited
    counts once. A call during which another was answered does not count: it waited in the server's queue.

    Args:
        failure_s: seconds of silence that are one failure.

    Attributes:
        answered_at: when the last call was answered, seconds of any steady clock.
    """

    def __init__(self, failure_s: float) -> None:
        self._failure_s = failure_s
        self._silent_s = 0.0
        self.answered_at = self._counted_until = -math.inf

    def cancelled(self, started: float, now: float) -> bool:
        """Count a call that was cancelled while it waited; returns whether this completes a failure."""
        if self.answered_at > started:
            return False
        if self.answered_at > self._counted_until:
            self._silent_s = 0.0
        self._silent_s += now - max(started, self._counted_until)
        self._counted_until = now
        if self._silent_s < self._failure_s:
            return False
        self._silent_s = 0.0
        return True


class Usability:
    """Counts the decisions in a row for which a server's answer could not be used, and probes a degraded server.

    Args:
        probe: asks the server for its model, its abilities and a decision; raises :class:`NoDecision` or
            ``TimeoutError`` if the answer cannot be used.

    Attributes:
        degraded: why the LLM's answers are unusable, with the beginning of the last one; None if they are usable.
    """

    def __init__(self, probe: Callable[[], Awaitable[None]]) -> None:
        self._probe = probe
        self._unusable = 0
        # After a passed probe the first unusable answer degrades the server again.
        self._suspect = False
        self._pause_s = FIRST_UNUSABLE_S
        self._task: asyncio.Task[None] | None = None
        self.degraded: str | None = None

    async def close(self) -> None:
        """Stop probing."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def usable(self) -> None:
        """Count a decision's answer that passed every check."""
        self._suspect = False
        self._pause_s = FIRST_UNUSABLE_S
        self._restore()

    def unusable(self, why: NoDecision) -> None:
        """Count a refusal, or an answer that failed a check; the error's text has the answer's beginning."""
        self._unusable += 1
        if self._unusable < _DEGRADED and not self._suspect and self.degraded is None:
            return
        quoted = "".join(c if c.isprintable() else "?" for c in str(why)[:_MOST_QUOTED])
        number = "1 answer" if self._unusable == 1 else f"{self._unusable} answers in a row"
        if self.degraded is None:
            log.warning("LLM degraded: %s cannot be used, the last (%s): %s", number, why.reason, quoted)
        self.degraded = f"{number} cannot be used, the last ({why.reason}): {quoted}"
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._probe_again(), name="llm-probe-again", context=Context())

    async def _probe_again(self) -> None:
        """Pause and probe until the answers can be used; each pause is twice as long, up to eight minutes."""
        while self.degraded is not None:
            await asyncio.sleep(self._pause_s)
            self._pause_s = min(_LONGEST_UNUSABLE_S, 2.0 * self._pause_s) if self.degraded else FIRST_UNUSABLE_S
            try:
                await self._probe()
            except (NoDecision, TimeoutError) as error:
                log.info("the LLM's answers are still unusable: %s", error or "none in time")
            else:
                self._suspect = self.degraded is not None
                self._restore()

    def _restore(self) -> None:
        self._unusable = 0
        if self.degraded is not None:
            self.degraded = None
            log.info("the LLM's answers can be used again")
