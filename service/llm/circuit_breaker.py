"""The circuit breaker: an LLM that fails repeatedly gets no calls for a while, so that no decision waits for it.

Closed, the breaker lets calls through. Three failures in a row open it, and no call goes through. After a pause the LLM
is probed in the background, so that no decision waits for the attempt. An answered probe makes the breaker half open:
calls go through again, the first failure opens it for twice as long, and the first answer closes it.
:mod:`service.llm.server` decides what counts as a failure.
"""

import math

_FAILURES = 3
_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 60.0


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
        return min(_LONGEST_PAUSE_S, _PAUSE_S * 2.0 ** min(self._openings - 1, 10))


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
