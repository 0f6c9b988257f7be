"""Decisions whose outcome is still to come, and the outcomes that are already applied."""

from __future__ import annotations

from typing import Any, Literal

from service.errors import Conflict, NotFound, Refused
from service.mission.events import Pending
from shared.bounded import BoundedDict
from shared.scenario import Scenario
from shared.wire import Outcome

# An outcome comes with the UAV's next request, so a few steps of a fleet suffice. Older entries are forgotten.
PENDING_PER_UAV = 8
_APPLIED_PER_UAV = 64


class AppliedOutcomes:
    """The newest applied outcomes by decision: the cost, and whether the transmission failed.

    They distinguish a duplicate of an outcome from an outcome that contradicts it.

    Args:
        most: the number of outcomes that are remembered.
    """

    def __init__(self, most: int) -> None:
        # The key is the ID's bytes, half as large as its text: an edge remembers hundreds for each mission.
        self._outcomes = BoundedDict[bytes, tuple[float, bool]](most)

    def __contains__(self, decision_id: str) -> bool:
        return bytes.fromhex(decision_id) in self._outcomes

    def __getitem__(self, decision_id: str) -> tuple[float, bool]:
        """The cost, and whether the transmission failed."""
        return self._outcomes[bytes.fromhex(decision_id)]

    def add(self, decision_id: str, cost: float, failed: bool) -> None:
        """Remember an outcome; past the limit the oldest is forgotten."""
        # A cost of -0.0 is stored as 0.
        self._outcomes[bytes.fromhex(decision_id)] = abs(cost), failed

    def state_dict(self) -> list[tuple[str, float, bool]]:
        """Decision ID, cost and failure of each outcome, oldest first."""
        return [(key.hex(), *outcome) for key, outcome in self._outcomes.items()]

    def load_state_dict(self, state: list[tuple[str, float, bool]]) -> None:
        """Restore a ``state_dict``."""
        self._outcomes.clear()
        for outcome in state:
            self.add(*outcome)


class PendingDecisions:
    """One mission's decisions that wait for their outcome, and its applied outcomes.

    Attributes:
        max_step_cost: an upper bound of a step's cost. Eq. 5 counts at most one failure for each UAV and one overflow
            for each sensor.
    """

    def __init__(self, mission_id: str, scenario: Scenario) -> None:
        self._mission_id = mission_id
        self._decisions: dict[str, Pending] = {}
        self.applied = AppliedOutcomes(_APPLIED_PER_UAV * scenario.uavs)
        self.max_step_cost = float(scenario.uavs + scenario.sensors)

    def knows(self, decision_id: str) -> bool:
        """Whether the decision waits for its outcome, or has it."""
        return decision_id in self._decisions or decision_id in self.applied

    def find(self, outcome: Outcome) -> Literal["pending", "applied"]:
        """Whether the decision still waits for an outcome, or this outcome is already applied.

        Raises:
            NotFound: the mission does not know the decision.
            Conflict: another outcome of the decision is applied.
        """
        name = outcome.decision_id
        if name in self._decisions:
            return "pending"
        if name not in self.applied:
            raise self._unknown(name, "decision_id")
        cost, failed = self.applied[name]
        if (min(outcome.cost, self.max_step_cost), outcome.failed) != (cost, failed):
            first = f"cost {cost:g}{', failed' if failed else ''}"
            raise Conflict("cost", f"decision {name} already has another outcome, which counts: {first}")
        return "applied"

    def check_outcome(self, outcome: Outcome, uav_id: int, at: str) -> None:
        """Check that this UAV may report the outcome.

        Args:
            at: the path of the outcome in the request's body, such as ``uavs[1].outcome.``.

        Raises:
            NotFound: the mission does not know the decision.
            Refused: the decision is another UAV's.
        """
        name = outcome.decision_id
        pending = self._decisions.get(name)
        if pending is None and name not in self.applied:
            raise self._unknown(name, f"{at}decision_id")
        if pending is not None and pending.uav_id != uav_id:
            raise Refused(
                f"{at}decision_id", f"decision {name} is UAV {pending.uav_id}'s, and only that UAV knows its outcome"
            )

    def add(self, decision: Pending) -> list[Pending]:
        """Wait for a decision's outcome; returns the UAV's oldest decisions, which are forgotten for it."""
        self._decisions[decision.decision_id] = decision
        own = [pending for pending in self._decisions.values() if pending.uav_id == decision.uav_id]
        forgotten = own[:-PENDING_PER_UAV]
        for pending in forgotten:
            del self._decisions[pending.decision_id]
        return forgotten

    def apply(self, outcome: Outcome) -> Pending:
        """Remember the outcome as applied; returns its decision, which no longer waits."""
        decision = self._decisions.pop(outcome.decision_id)
        self.applied.add(decision.decision_id, outcome.cost, outcome.failed)
        return decision

    def state_dict(self) -> list[dict[str, Any]]:
        """The waiting decisions, oldest first; the applied outcomes have a state of their own."""
        return [decision.state_dict() for decision in self._decisions.values()]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        """Restore a ``state_dict``."""
        self._decisions = {pending["decision_id"]: Pending.of(pending) for pending in state}

    def _unknown(self, name: str, field: str) -> NotFound:
        return NotFound(field, f"mission {self._mission_id} does not know decision {name}, or has forgotten it")
