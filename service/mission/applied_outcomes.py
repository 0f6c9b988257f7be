"""Outcomes that were applied: so one that comes again is known, and one that contradicts an earlier one."""

from __future__ import annotations

import math


class AppliedOutcomes:
    """The newest outcomes by decision, a hundred bytes each: an edge remembers hundreds of each of its missions.

    Args:
        most: how many are remembered.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # The oldest first. The cost of a transmission that failed has the sign, 0 too.
        self._costs: dict[bytes, float] = {}

    def __contains__(self, decision_id: str) -> bool:
        return bytes.fromhex(decision_id) in self._costs

    def __getitem__(self, decision_id: str) -> tuple[float, bool]:
        """Its cost, and whether the transmission failed."""
        signed = self._costs[bytes.fromhex(decision_id)]
        return abs(signed), math.copysign(1.0, signed) < 0

    def add(self, decision_id: str, cost: float, failed: bool) -> None:
        """Remember one; the oldest of too many is forgotten."""
        self._costs[bytes.fromhex(decision_id)] = math.copysign(cost, -1.0 if failed else 1.0)
        while len(self._costs) > self._most:
            del self._costs[next(iter(self._costs))]

    def clear(self) -> None:
        """Forget all."""
        self._costs.clear()

    def state_dict(self) -> list[tuple[str, float, bool]]:
        """By decision, cost and whether it failed, the oldest first."""
        return [(key.hex(), *self[key.hex()]) for key in self._costs]

    def load_state_dict(self, state: list[tuple[str, float, bool]]) -> None:
        """As it was when the state was taken."""
        self.clear()
        for told in state:
            self.add(*told)
