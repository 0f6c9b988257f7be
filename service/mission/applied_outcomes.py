"""Outcomes that were applied: so one that comes again is known, and one that contradicts an earlier one."""

from __future__ import annotations

from shared.bounded import BoundedDict


class AppliedOutcomes:
    """The newest outcomes by decision: its cost, and whether the transmission failed.

    Args:
        most: how many are remembered.
    """

    def __init__(self, most: int) -> None:
        # By the ID's bytes, half as large as its text: an edge remembers hundreds of each of its missions.
        self._outcomes = BoundedDict[bytes, tuple[float, bool]](most)

    def __contains__(self, decision_id: str) -> bool:
        return bytes.fromhex(decision_id) in self._outcomes

    def __getitem__(self, decision_id: str) -> tuple[float, bool]:
        """Its cost, and whether the transmission failed."""
        return self._outcomes[bytes.fromhex(decision_id)]

    def add(self, decision_id: str, cost: float, failed: bool) -> None:
        """Remember one; the oldest of too many is forgotten."""
        # Of a cost of -0.0, the 0.
        self._outcomes[bytes.fromhex(decision_id)] = abs(cost), failed

    def state_dict(self) -> list[tuple[str, float, bool]]:
        """By decision, cost and whether it failed, the oldest first."""
        return [(key.hex(), *outcome) for key, outcome in self._outcomes.items()]

    def load_state_dict(self, state: list[tuple[str, float, bool]]) -> None:
        """As it was when the state was taken."""
        self._outcomes.clear()
        for told in state:
            self.add(*told)
