"""Scheduling policies that need no edge, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from simulator.policies.eof import EarliestOverflowFirst
from simulator.policies.learned import Learned
from simulator.policies.max_gain import MaximumGain
from simulator.policies.mpc import RecedingHorizon
from simulator.policies.mpc_formula import FormulaPlanner
from simulator.policies.nearest import NearestNeighbour
from simulator.policies.policy import Policy
from simulator.policies.random_choice import RandomChoice
from simulator.policies.round_robin import RoundRobin
from simulator.policies.wqcs import WeightedQueueChannel

_POLICIES: dict[str, Callable[[], Policy]] = {
    "random": RandomChoice,
    "round_robin": RoundRobin,
    "eof": EarliestOverflowFirst,
    "wqcs": WeightedQueueChannel,
    "max_gain": MaximumGain,
    "nearest": NearestNeighbour,
    "mpc": RecedingHorizon,
    "mpc_formula": FormulaPlanner,
}
# They need torch (extra `service`), and fly only scenarios of the size of their training.
LEARNED_NAMES = ("madqn", "mappo")
_POLICIES |= {name: partial(Learned, name) for name in LEARNED_NAMES}
POLICY_NAMES: tuple[str, ...] = tuple(_POLICIES)


def policy_named(name: str) -> Policy:
    """A new policy of that name.

    Raises:
        ValueError: no policy has that name; the message lists the names.
        UsageError: the policy needs an extra that is not installed; the message names it.
    """
    try:
        return _POLICIES[name]()
    except KeyError:
        raise ValueError(f"unknown policy {name!r}: choose one of {', '.join(POLICY_NAMES)}") from None
