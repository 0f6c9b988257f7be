"""Scheduling policies that need no edge, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from shared.scenario import Scenario
from simulator.policies.eof import EarliestOverflowFirst
from simulator.policies.learned import Learned
from simulator.policies.max_gain import MaximumGain
from simulator.policies.mpc import RecedingHorizon
from simulator.policies.nearest import NearestNeighbour
from simulator.policies.random_choice import RandomChoice
from simulator.policies.round_robin import RoundRobin
from simulator.policies.wqcs import WeightedQueueChannel
from simulator.world import Observation

__all__ = ["LEARNED_NAMES", "POLICY_NAMES", "Policy", "policy_named"]


class Policy(Protocol):
    """Decides for a fleet, one UAV at a time, from what that UAV knows and nothing else."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission. Called before the first ``decide``."""
        ...

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Choose a sensor, and a velocity in m/s.

        Args:
            uav: index of the UAV.
            observation: what it knows.
            taken: sensors that UAVs decided earlier in this step chose.
        """
        ...


_POLICIES: dict[str, Callable[[], Policy]] = {
    "random": RandomChoice,
    "round_robin": RoundRobin,
    "eof": EarliestOverflowFirst,
    "wqcs": WeightedQueueChannel,
    "max_gain": MaximumGain,
    "nearest": NearestNeighbour,
    "mpc": RecedingHorizon,
}

# These need the extra `marl`, and fly only scenarios of the size that they were trained in.
LEARNED_NAMES = ("madqn", "mappo")
_POLICIES |= {name: partial(Learned, name) for name in LEARNED_NAMES}

POLICY_NAMES: tuple[str, ...] = tuple(_POLICIES)


def policy_named(name: str) -> Policy:
    """A new policy of that name.

    Raises:
        ValueError: no policy has that name; the message lists the names.
        BadUse: the policy needs an extra that is not installed; the message names it.
    """
    try:
        return _POLICIES[name]()
    except KeyError:
        raise ValueError(f"unknown policy {name!r}: choose one of {', '.join(POLICY_NAMES)}") from None
