"""The circuit breaker: an LLM that fails again and again is not asked for a while, so that nobody waits for it.

Closed, calls go through. After three failures in a row it opens, and no decision is kept waiting. After a pause the LLM
is probed beside the decisions, so that no UAV pays for the attempt; where the probe is answered it is half open: calls
go through again, and the first failure opens it for twice as long, the first answer closes it. What counts as a failure
is for :mod:`service.llm.server` to say.
"""

from __future__ import annotations

_FAILURES = 3
_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 60.0


class CircuitBreaker:
    """Counts the failures of one LLM."""

    def __init__(self) -> None:
        self._failures = 0
        self._openings = 0

    def answered(self) -> None:
        """A call was answered."""
        self._failures = self._openings = 0

    def failed(self) -> bool:
        """A call was not; returns whether that opens the breaker."""
        self._failures += 1
        if self._failures < (1 if self._openings else _FAILURES):
            return False
        self._failures = 0
        self._openings += 1
        return True

    @property
    def pause_s(self) -> float:
        """How long to leave the LLM alone, once open."""
        return min(_LONGEST_PAUSE_S, _PAUSE_S * 2.0 ** min(self._openings - 1, 10))
