"""The experiences of a fleet: its past decisions, and the selection of them for the prompt.

The block of experiences only grows between compactions, so that an LLM server's prefix cache stays valid: past the
limit it is reduced to half of the limit. The ``selection`` is one of:

- ``recent``: the newest.
- ``failures``: the newest of each sensor, first of those whose newest one failed, then what is newest.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

from shared.wire.schemas import Selection

# Experiences to select from: three missions of the paper's length.
_REMEMBERED = 270


@dataclass(frozen=True, slots=True)
class Experience:
    """A past decision: its line in the prompt, its sensor, and whether the transmission failed."""

    line: str
    sensor_id: int
    failed: bool


class Experiences:
    """One mission's experiences; with ``recent`` only those in the block are remembered.

    Args:
        limit: the most lines of the block; with 0 nothing is remembered.
        selection: the rule that a compaction selects by.
    """

    def __init__(self, limit: int, selection: Selection = "recent") -> None:
        self.limit = limit
        self.selection: Selection = selection
        self.block: list[str] = []
        self.compactions = 0
        self._remembered: deque[Experience] = deque(maxlen=max(_REMEMBERED, limit))

    def remember(self, experience: Experience) -> None:
        """Append the experience to the block, and compact the block past the limit."""
        if self.limit == 0:
            return
        if self.selection != "recent":
            self._remembered.append(experience)
        self.block.append(experience.line)
        if len(self.block) > self.limit:
            self.block = self._selected(max(1, self.limit // 2))
            self.compactions += 1

    def state_dict(self) -> dict[str, Any]:
        """The block and all remembered experiences, as copies."""
        remembered = [[e.line, e.sensor_id, e.failed] for e in self._remembered]
        return {"block": list(self.block), "compactions": self.compactions, "remembered": remembered}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``, also of an earlier version, whose experiences have more between line and sensor."""
        self.block, self.compactions = state["block"], state["compactions"]
        self._remembered.clear()
        if self.selection != "recent":
            self._remembered.extend(Experience(row[0], *row[-2:]) for row in state["remembered"])

    def _selected(self, keep: int) -> list[str]:
        """Of ``failures``, lines in order of time: the newest of each sensor, failed ones first, then the newest."""
        if self.selection == "recent":
            return self.block[-keep:]
        known = list(self._remembered)
        newest = {experience.sensor_id: number for number, experience in enumerate(known)}.values()
        by_worth = sorted(range(len(known)), key=lambda n: (n in newest, n in newest and known[n].failed, n))
        return [known[number].line for number in sorted(by_worth[-keep:])]
