"""Whether the answers of an LLM server can be used; a healthy server may give only unusable ones."""

from __future__ import annotations

import logging

from service.llm.answers import NoDecision

log = logging.getLogger(__name__)

# Answers in a row that cannot be used. A small model errs now and then.
_DEGRADED = 5
_MOST_QUOTED = 200


_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 30.0, 480.0


class Usability:
    """Counts the decisions in a row for which a server's answer could not be used.

    Attributes:
        degraded: why the LLM's answers are unusable, with the beginning of the last one; None if they are usable.
        pause_s: seconds until a degraded server is probed.
    """

    def __init__(self) -> None:
        self._unusable = 0
        self._suspect = False
        self.degraded: str | None = None
        self.pause_s = _FIRST_PAUSE_S

    def usable(self) -> None:
        """Count a decision's answer that passed every check."""
        self._suspect = False
        self.pause_s = _FIRST_PAUSE_S
        self._restore()

    def probed(self, passed: bool) -> None:
        """Count a probe of a degraded server; if it passed, the first unusable answer degrades the server again."""
        self.pause_s = min(_LONGEST_PAUSE_S, 2.0 * self.pause_s)
        if passed:
            self._suspect = True
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

    def _restore(self) -> None:
        self._unusable = 0
        if self.degraded is not None:
            self.degraded = None
            log.info("the LLM's answers can be used again")
