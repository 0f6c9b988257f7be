"""Whose turn it was: the sensors that a fleet's UAVs were given at each step, and by which of their attempts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# UAVs of one fleet may be this many steps apart.
STEPS_APART = 64


@dataclass(frozen=True, slots=True)
class Reservation:
    """The sensor that a UAV was given at a step, and by which of its attempts."""

    uav_id: int
    sensor_id: int
    decision_id: str
    attempt: int


class Reservations:
    """By step and UAV; the earliest of too many steps is forgotten."""

    def __init__(self) -> None:
        # A step's in a tuple, and attempts only while they are under way: a mission has 64 steps of them.
        self._given: dict[int, tuple[Reservation, ...]] = {}
        self._attempts: dict[int, dict[int, int]] = {}

    def reserved(self, step: int, uav_id: int) -> frozenset[int]:
        """Sensors that other UAVs were given this step."""
        return frozenset(given.sensor_id for given in self._given.get(step, ()) if given.uav_id != uav_id)

    def attempt(self, step: int, uav_id: int) -> int:
        """Number a request of a UAV at a step: when it asks again, the later answer counts."""
        answered = self.given(step, uav_id)
        attempts = self._attempts.setdefault(step, {})
        attempts[uav_id] = 1 + max(attempts.get(uav_id, 0), 0 if answered is None else answered.attempt)
        number = attempts[uav_id]
        _forget_lowest(self._attempts)
        return number

    def given(self, step: int, uav_id: int) -> Reservation | None:
        """What the UAV was told last at this step."""
        return next((given for given in self._given.get(step, ()) if given.uav_id == uav_id), None)

    def give(self, step: int, given: Reservation) -> None:
        """Reserve a sensor, and free what the UAV was given before at this step."""
        others = tuple(other for other in self._given.get(step, ()) if other.uav_id != given.uav_id)
        self._given[step] = (*others, given)
        _forget_lowest(self._given)
        attempts = self._attempts.get(step, {})
        if attempts.get(given.uav_id) == given.attempt:
            del attempts[given.uav_id]
            if not attempts:
                del self._attempts[step]

    def state_dict(self) -> dict[str, Any]:
        """All of it, as copies."""
        return {
            "given": {
                step: {g.uav_id: [g.sensor_id, g.decision_id, g.attempt] for g in given}
                for step, given in self._given.items()
            },
            "attempts": {step: dict(by_uav) for step, by_uav in self._attempts.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken."""
        self._given = {
            step: tuple(Reservation(uav, *given) for uav, given in by_uav.items())
            for step, by_uav in state["given"].items()
        }
        self._attempts = state["attempts"]


def _forget_lowest(by_step: dict[int, Any]) -> None:
    while len(by_step) > STEPS_APART:
        del by_step[min(by_step)]
