"""Whether the answers of an LLM server can be used; a healthy server may give only unusable ones."""

from __future__ import annotations

import logging

from service.llm.answers import NoDecision

log = logging.getLogger(__name__)

# Answers in a row that cannot be used. A small model errs now and then.
_DEGRADED = 5
_MOST_QUOTED = 200


class Usability:
    """Counts the decisions in a row for which a server's answer could not be used.

    Attributes:
        degraded: why the LLM's answers are unusable, with the beginning of the last one; None if they are usable.
    """

    def __init__(self) -> None:
        self._unusable = 0
        self.degraded: str | None = None

    def usable(self) -> None:
        """Count an answer that passed every check."""
        self._unusable = 0
        if self.degraded is not None:
            self.degraded = None
            log.info("the LLM's answers can be used again")

    def unusable(self, why: NoDecision) -> None:
        """Count a refusal, or an answer that failed a check; the error's text has the answer's beginning."""
        self._unusable += 1
        if self._unusable < _DEGRADED:
            return
        quoted = "".join(c if c.isprintable() else "?" for c in str(why)[:_MOST_QUOTED])
        if self.degraded is None:
            log.warning(
                "LLM degraded: %d answers in a row cannot be used, the last (%s): %s", _DEGRADED, why.reason, quoted
            )
        self.degraded = f"{self._unusable} answers in a row cannot be used, the last ({why.reason}): {quoted}"
