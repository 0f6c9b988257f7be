"""The interface of a scheduling policy."""

from typing import Protocol, runtime_checkable

from shared.world.scenario import Scenario
from simulator.world.observation import Observation


class Policy(Protocol):
    """Decides for a fleet, one UAV at a time, only from that UAV's observation."""

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission. Called before the first ``decide``."""
        ...

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """Choose a sensor, and a velocity in m/s.

        Args:
            uav: index of the UAV.
            observation: of that UAV.
            taken: sensors chosen by earlier UAVs of this step.
        """
        ...


@runtime_checkable
class LearningPolicy(Protocol):
    """A policy that learns from the outcomes of its decisions."""

    def learn(self, uav: int, step: int, failed: bool) -> None:
        """Take the outcome of a UAV's decision of a step: whether the transmission failed."""
        ...
