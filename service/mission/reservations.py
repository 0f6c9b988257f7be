"""Reservations: the sensor that each UAV of a fleet has at each step, and the attempt that reserved it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# UAVs of one fleet may be this many steps apart.
MAX_STEPS_APART = 64


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
        """The number of a new request of a UAV at a step; of two attempts the later one's answer counts."""
        answered = self.of(step, uav_id)
        attempts = self._attempts.setdefault(step, {})
        number = 1 + max(attempts.get(uav_id, 0), 0 if answered is None else answered.attempt)
        attempts[uav_id] = number
        _forget_earliest(self._attempts)
        return number

    def of(self, step: int, uav_id: int) -> Reservation | None:
        """The UAV's reservation at this step."""
        return next((own for own in self._by_step.get(step, ()) if own.uav_id == uav_id), None)

    def reserve(self, step: int, reservation: Reservation) -> None:
        """Reserve a sensor in place of the UAV's earlier one at this step; the attempt is no longer open."""
        uav_id = reservation.uav_id
        others = tuple(other for other in self._by_step.get(step, ()) if other.uav_id != uav_id)
        self._by_step[step] = (*others, reservation)
        _forget_earliest(self._by_step)
        attempts = self._attempts.get(step, {})
        if attempts.get(uav_id) == reservation.attempt:
            del attempts[uav_id]
            if not attempts:
                del self._attempts[step]

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


def _forget_earliest(by_step: dict[int, Any]) -> None:
    while len(by_step) > MAX_STEPS_APART:
        del by_step[min(by_step)]
