"""Scheduling policies that need no edge, by name."""

from collections.abc import Callable
from functools import partial
from typing import Protocol, runtime_checkable

from shared.kit.own_code import imported
from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.policies import hand_written
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.world.observation import Observation


class Policy(Protocol):
    """Decides for a fleet, one UAV at a time, only from that UAV's observation."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission. Called before the first ``decide``."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Choose a sensor, and a velocity in m/s.

        Args:
            uav: index of the UAV.
            observation: of that UAV.
            taken: sensors chosen by earlier UAVs of this step.
        """


@runtime_checkable
class LearningPolicy(Protocol):
    """A policy that learns from the outcomes of its decisions."""

    def learn(self, uav: int, step: int, failed: bool) -> None:
        """Take the outcome of a UAV's decision of a step: whether the transmission failed."""


_POLICIES: dict[str, Callable[[], Policy]] = {
    "random": hand_written.RandomChoice,
    "round_robin": hand_written.RoundRobin,
    "eof": hand_written.EarliestOverflowFirst,
    "wqcs": hand_written.WeightedQueueChannel,
    "eof_coordinated": partial(hand_written.EarliestOverflowFirst, coordinated=True),
    "wqcs_coordinated": partial(hand_written.WeightedQueueChannel, coordinated=True),
    "longest_queue": hand_written.LongestQueue,
    "queue_and_channel": hand_written.QueueAndChannel,
    "max_gain": hand_written.MaximumGain,
    "nearest": hand_written.NearestNeighbour,
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
