"""A fleet's decisions: their reservations, pending outcomes and applied outcomes."""

import math
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from service.errors import Conflict, NotFound, Refused
from service.learning.modules import Sample
from service.prompting.rows import Cells
from shared.kit.bounded import BoundedDict
from shared.wire.schemas import Outcome
from shared.world.scenario import Scenario

# The largest difference between the steps of two UAVs of a fleet.
MAX_STEPS_APART = 64
# An outcome comes with the UAV's next request, so a few steps of a fleet suffice. Older entries are forgotten.
PENDING_PER_UAV = 8
_APPLIED_PER_UAV = 64


def new_decision_id() -> str:
    """An ID that begins with its time: 48 bits of Unix milliseconds, then 80 random ones."""
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(10)}"


class Pending(NamedTuple):
    """A decision whose outcome is pending.

    Attributes:
        seen: the chosen sensor's row at the decision.
        sample: the training sample; None if the modules had no part in the decision.
    """

    decision_id: str
    uav_id: int
    step: int
    sensor_id: int
    velocity: int
    seen: Cells
    sample: Sample | None

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> "Pending":
        """From its fields by name, the sample's in their order."""
        sample = None if state["sample"] is None else Sample(*state["sample"])
        return cls(**{**state, "sample": sample})


class AppliedOutcomes:
    """The newest applied outcomes by decision: the cost, and whether the transmission failed.

    They distinguish a duplicate of an outcome from an outcome that contradicts it.

    Args:
        most: the number of outcomes that are remembered.
    """

    def __init__(self, most: int) -> None:
        # A mission remembers hundreds: the sign of the cost says whether the transmission failed.
        self._outcomes = BoundedDict[str, float](most)

    def __contains__(self, decision_id: str) -> bool:
        return decision_id in self._outcomes

    def __getitem__(self, decision_id: str) -> tuple[float, bool]:
        """The cost, and whether the transmission failed."""
        cost = self._outcomes[decision_id]
        return abs(cost), math.copysign(1.0, cost) < 0

    def add(self, decision_id: str, cost: float, failed: bool) -> None:
        """Remember an outcome; past the limit the oldest is forgotten."""
        self._outcomes[decision_id] = math.copysign(cost, -1.0 if failed else 1.0)

    def state_dict(self) -> list[tuple[str, float, bool]]:
        """Decision ID, cost and failure of each outcome, oldest first."""
        return [(name, *self[name]) for name in self._outcomes]

    def load_state_dict(self, state: list[tuple[str, float, bool]]) -> None:
        """Restore a ``state_dict``."""
        self._outcomes.clear()
        for outcome in state:
            self.add(*outcome)


class PendingDecisions:
    """One mission's decisions that wait for their outcome, and its applied outcomes.

    Attributes:
        max_step_cost: an upper bound of a step's cost. The paper's P_l counts at most one failure for each UAV and one
            overflow for each sensor.
    """

    def __init__(self, mission_id: str, scenario: Scenario) -> None:
        self._mission_id = mission_id
        self._decisions: dict[str, Pending] = {}
        self.applied = AppliedOutcomes(_APPLIED_PER_UAV * scenario.uavs)
        self.max_step_cost = float(scenario.uavs + scenario.sensors)

    def knows(self, decision_id: str) -> bool:
        """Whether the decision's outcome is pending or applied."""
        return decision_id in self._decisions or decision_id in self.applied

    def waits_for(self, step: int) -> bool:
        """Whether a decision of the step has a pending outcome."""
        return any(pending.step == step for pending in self._decisions.values())

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
        """Add a decision; returns the UAV's oldest decisions, which are forgotten in exchange."""
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
        return [decision._asdict() for decision in self._decisions.values()]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        """Restore a ``state_dict``."""
        self._decisions = {pending["decision_id"]: Pending.of(pending) for pending in state}

    def _unknown(self, name: str, field: str) -> NotFound:
        return NotFound(field, f"mission {self._mission_id} does not know decision {name}, or has forgotten it")


@dataclass(frozen=True, slots=True)
class Reservation:
    """A UAV's sensor at a step, and the number of the UAV's attempt that reserved it."""

    uav_id: int
    sensor_id: int
    decision_id: str
    attempt: int


class Reservations:
    """Reservations and open attempts by step and UAV; past the limit the earliest step is forgotten."""

    def __init__(self) -> None:
        # Tuples, and attempts only while they are open, save memory: a mission has 64 steps of them.
        self._by_step: dict[int, tuple[Reservation, ...]] = {}
        self._attempts: dict[int, dict[int, int]] = {}

    def of_others(self, step: int, uav_id: int) -> frozenset[int]:
        """IDs of the sensors that other UAVs have at this step."""
        return frozenset(other.sensor_id for other in self._by_step.get(step, ()) if other.uav_id != uav_id)

    def attempt(self, step: int, uav_id: int) -> int:
        """The number of a new request of a UAV at a step; of two attempts, the later one's answer counts."""
        answered = self.of(step, uav_id)
        attempts = self._attempts.setdefault(step, {})
        number = 1 + max(attempts.get(uav_id, 0), 0 if answered is None else answered.attempt)
        attempts[uav_id] = number
        if len(self._attempts) > MAX_STEPS_APART:
            del self._attempts[min(self._attempts)]
        return number

    def of(self, step: int, uav_id: int) -> Reservation | None:
        """The UAV's reservation at this step."""
        return next((own for own in self._by_step.get(step, ()) if own.uav_id == uav_id), None)

    def newest_at(self, now: float) -> float | None:
        """When the newest decision was made, Unix seconds, no later than ``now``; None without any that says so."""
        every = (own.decision_id for reservations in self._by_step.values() for own in reservations)
        # IDs of earlier versions are random: they say any time, of which nearly all are in the future.
        return max((at for at in (int(name[:12], 16) / 1e3 for name in every) if at <= now), default=None)

    def reserve(self, step: int, reservation: Reservation) -> Reservation | None:
        """Reserve a sensor in place of the UAV's earlier one at this step, which is returned.

        The attempt is no longer open.

        Raises:
            Conflict: a later attempt of this UAV at this step already has its answer; nothing is reserved.
        """
        uav_id, earlier = reservation.uav_id, self.of(step, reservation.uav_id)
        if earlier is not None and earlier.attempt > reservation.attempt:
            raise Conflict("step", f"a later request of UAV {uav_id} for step {step} is already answered")
        others = tuple(other for other in self._by_step.get(step, ()) if other.uav_id != uav_id)
        self._by_step[step] = (*others, reservation)
        if len(self._by_step) > MAX_STEPS_APART:
            del self._by_step[min(self._by_step)]
        attempts = self._attempts.get(step, {})
        if attempts.get(uav_id) == reservation.attempt:
            del attempts[uav_id]
            if not attempts:
                del self._attempts[step]
        return earlier

    def state_dict(self) -> dict[str, Any]:
        """Reservations and open attempts, as copies."""
        return {
            "given": {
                step: {own.uav_id: [own.sensor_id, own.decision_id, own.attempt] for own in reservations}
                for step, reservations in self._by_step.items()
            },
            "attempts": {step: dict(by_uav) for step, by_uav in self._attempts.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self._by_step = {
            step: tuple(Reservation(uav, *reserved) for uav, reserved in by_uav.items())
            for step, by_uav in state["given"].items()
        }
        self._attempts = state["attempts"]
