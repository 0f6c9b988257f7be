"""Whose turn it was: the sensors that a fleet's UAVs were given at each step, and by which of their attempts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# UAVs of one fleet may be this many steps apart.
_STEPS = 64


@dataclass(frozen=True, slots=True)
class Given:
    """The sensor that a UAV was given at a step, and by which of its attempts."""

    sensor_id: int
    decision_id: str
    attempt: int


class Turns:
    """By step and UAV; the earliest of too many steps is forgotten."""

    def __init__(self) -> None:
        self._given: dict[int, dict[int, Given]] = {}
        self._attempts: dict[int, dict[int, int]] = {}

    def reserved(self, step: int, uav_id: int) -> frozenset[int]:
        """Sensors that other UAVs were given this step."""
        return frozenset(given.sensor_id for uav, given in self._given.get(step, {}).items() if uav != uav_id)

    def attempt(self, step: int, uav_id: int) -> int:
        """Number a request of a UAV at a step: when it asks again, the later answer counts."""
        attempts = self._attempts.setdefault(step, {})
        attempts[uav_id] = attempts.get(uav_id, 0) + 1
        _forget_lowest(self._attempts)
        return attempts[uav_id]

    def given(self, step: int, uav_id: int) -> Given | None:
        """What the UAV was told last at this step."""
        return self._given.get(step, {}).get(uav_id)

    def give(self, step: int, uav_id: int, given: Given) -> None:
        """Reserve a sensor, and free what the UAV was given before at this step."""
        self._given.setdefault(step, {})[uav_id] = given
        _forget_lowest(self._given)

    def state_dict(self) -> dict[str, Any]:
        """All of it, as copies."""
        return {
            "given": {
                step: {uav: [g.sensor_id, g.decision_id, g.attempt] for uav, g in by_uav.items()}
                for step, by_uav in self._given.items()
            },
            "attempts": {step: dict(by_uav) for step, by_uav in self._attempts.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken."""
        self._given = {
            step: {uav: Given(*given) for uav, given in by_uav.items()} for step, by_uav in state["given"].items()
        }
        self._attempts = state["attempts"]


def _forget_lowest(by_step: dict[int, Any]) -> None:
    while len(by_step) > _STEPS:
        del by_step[min(by_step)]
