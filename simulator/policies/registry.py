"""Scheduling policies that need no edge, by name."""

from collections.abc import Callable
from functools import partial

from shared.kit.own_code import imported
from simulator.errors import UsageError
from simulator.policies.hand_written import (
    LongestQueue,
    MaximumGain,
    NearestNeighbour,
    QueueAndChannel,
    RandomChoice,
    RoundRobin,
)
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.policies.paper_schemes import EarliestOverflowFirst, WeightedQueueChannel
from simulator.policies.policy import Policy

_POLICIES: dict[str, Callable[[], Policy]] = {
    "random": RandomChoice,
    "round_robin": RoundRobin,
    "eof": EarliestOverflowFirst,
    "wqcs": WeightedQueueChannel,
    "eof_coordinated": partial(EarliestOverflowFirst, coordinated=True),
    "wqcs_coordinated": partial(WeightedQueueChannel, coordinated=True),
    "longest_queue": LongestQueue,
    "queue_and_channel": QueueAndChannel,
    "max_gain": MaximumGain,
    "nearest": NearestNeighbour,
    "mpc": RecedingHorizonPolicy,
}
POLICY_NAMES: tuple[str, ...] = tuple(_POLICIES)


def policy_named(name: str) -> Policy:
    """A new policy: one of this table by its name, or one's own as ``MODULE:CLASS``.

    Raises:
        ValueError: no policy has that name; the message lists the names.
        UsageError: the module or the class cannot be found, or needs an extra that is not installed.
    """
    if ":" in name:
        return _imported(name)
    try:
        return _POLICIES[name]()
    except KeyError:
        known = ", ".join(POLICY_NAMES)
        raise ValueError(f"unknown policy {name!r}: choose one of {known}, or MODULE:CLASS") from None


def _imported(name: str) -> Policy:
    """The policy that a class without arguments makes."""
    try:
        made = imported(name)()
    except (TypeError, ValueError) as error:
        raise UsageError(f"policy {name}: {error}") from None
    for method in ("reset", "decide"):
        if not callable(getattr(made, method, None)):
            raise UsageError(f"policy {name}: it has no method {method}; see docs/guides/policy.md")
    policy: Policy = made
    return policy
