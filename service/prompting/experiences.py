"""The experiences of a fleet: its past decisions, and the selection of them for the prompt.

The block of experiences only grows between compactions, so that an LLM server's prefix cache stays valid. Only a
compaction selects. The ``selection`` is one of:

- ``recent``: every outcome is appended; past the limit the older half is dropped.
- ``best``: every outcome is appended; past the limit the block is reduced to half of the limit, chosen by cost among
  all remembered experiences: the lowest costs, and for a quarter of the lines the highest, as warnings. The worst come
  first and the best last. After the ranking of examples by Zhou et al., arXiv 2408.00214.
- ``failures``: every outcome is appended; past the limit the block is reduced to half of the limit, in order of time:
  the newest experience of each sensor, first of those whose newest one failed, and then what is newest.
- ``similar``: nearest neighbours by state. After as many outcomes as the limit, the block becomes half of the limit:
  the experiences nearest to the fleet's newest decisions, the nearest last. Between compactions nothing is appended.
  Instead the last block of the prompt, which is never cached, has the one experience nearest to the current rows,
  unless the block has it. That is one line a decision, as with the other selections.

The distance of two experiences is the root mean square difference of the attention features of their chosen rows, each
0..1: ``d(a, b) = |a - b| / sqrt(dim)``. It is 0 for equal rows and at most 1. The distance to several rows is the least
of the distances to each.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.wire.schemas import Selection

# Experiences to select from: three missions of the paper's length.
_REMEMBERED = 270
# Experiences in the last block with `similar`. More would cost more uncached tokens a decision than `recent` does.
NEAREST = 1


@dataclass(frozen=True, slots=True)
class Experience:
    """A past decision: its line in the prompt, its cost, and the chosen row's attention features ``(d,)``, each 0..1.

    ``features`` is None if the modules had no part in the decision; `similar` ignores such an experience.
    """

    line: str
    cost: float
    features: NDArray[np.float32] | None
    sensor_id: int
    failed: bool


class Experiences:
    """One mission's experiences; with ``recent`` only those in the block are remembered.

    Args:
        limit: the most lines of the block; with 0 nothing is remembered.
        selection: the rule that a compaction selects by.
        uavs: the number of the newest decisions that describe the fleet's present state.
    """

    def __init__(self, limit: int, selection: Selection = "recent", uavs: int = 1) -> None:
        self.limit = limit
        self.selection: Selection = selection
        self.block: list[str] = []
        self.compactions = 0
        self._uavs = uavs
        self._remembered: deque[Experience] = deque(maxlen=max(_REMEMBERED, limit))
        self._since_compaction = 0

    def remember(self, experience: Experience) -> None:
        """Append the experience to the block, or compact the block."""
        if self.limit == 0:
            return
        if self.selection != "recent":
            self._remembered.append(experience)
        self._since_compaction += 1
        if self.selection != "similar":
            self.block.append(experience.line)
        elif self._since_compaction < self.limit:
            return
        if self.selection == "similar" or len(self.block) > self.limit:
            self.block = self._selected(max(1, self.limit // 2))
            self.compactions += 1
            self._since_compaction = 0

    def nearest(self, rows: NDArray[np.float32]) -> list[str]:
        """Lines for the prompt's last block: with ``similar`` the experience nearest to any of the rows ``(n, d)``.

        Empty with another selection, without rows, and where the block has the nearest one.
        """
        if self.selection != "similar" or not len(rows):
            return []
        return [line for line in self._nearest(rows, NEAREST) if line not in self.block]

    def state_dict(self) -> dict[str, Any]:
        """The block and all remembered experiences, as copies."""
        return {
            "block": list(self.block),
            "compactions": self.compactions,
            "since": self._since_compaction,
            "remembered": [[e.line, e.cost, e.features, e.sensor_id, e.failed] for e in self._remembered],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.block, self.compactions, self._since_compaction = state["block"], state["compactions"], state["since"]
        self._remembered.clear()
        if self.selection != "recent":
            self._remembered.extend(Experience(*remembered) for remembered in state["remembered"])

    def _selected(self, keep: int) -> list[str]:
        if self.selection == "recent":
            return self.block[-keep:]
        if self.selection == "best":
            return self._ranked(keep)
        if self.selection == "failures":
            return self._failures(keep)
        present = [e.features for e in list(self._remembered)[-self._uavs :] if e.features is not None]
        return self._nearest(np.stack(present), keep) if present else []

    def _failures(self, keep: int) -> list[str]:
        """Lines in order of time: the newest of each sensor, failed ones first, and then what is newest."""
        known = list(self._remembered)
        newest = {experience.sensor_id: number for number, experience in enumerate(known)}.values()
        by_worth = sorted(range(len(known)), key=lambda n: (n in newest, n in newest and known[n].failed, n))
        return [known[number].line for number in sorted(by_worth[-keep:])]

    def _ranked(self, keep: int) -> list[str]:
        """Lines of the highest costs, then of the lowest, best last; the newest of equal ones."""
        newest_first = reversed(self._remembered)
        by_cost = sorted(newest_first, key=lambda experience: experience.cost)
        lines = _distinct(experience.line for experience in by_cost)
        warnings = min(keep // 4, max(0, len(lines) - keep))
        best, worst = lines[: keep - warnings], lines[len(lines) - warnings :]
        return [*reversed(worst), *reversed(best)]

    def _nearest(self, rows: NDArray[np.float32], keep: int) -> list[str]:
        """Lines of the experiences nearest to any of the rows, nearest last; the newest of equal ones."""
        known = [(e.line, e.features) for e in reversed(self._remembered) if e.features is not None]
        if not known:
            return []
        features = np.stack([features for _, features in known])
        distance = np.sqrt(((features[:, None] - rows[None]) ** 2).mean(axis=2)).min(axis=1)
        return _distinct(known[i][0] for i in np.argsort(distance, kind="stable"))[:keep][::-1]


def _distinct(lines: Iterable[str]) -> list[str]:
    """Each line once, in order of its first occurrence."""
    return list(dict.fromkeys(lines))
