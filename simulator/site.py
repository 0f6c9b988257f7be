"""Where a mission is flown: a scenario, and the arrivals if they were recorded rather than drawn."""

from __future__ import annotations

from dataclasses import dataclass

from shared.scenario import Scenario
from simulator.sensors import IntArray
from simulator.world import Cost, PipelineWorld


@dataclass(frozen=True, eq=False)
class Site:
    """A scenario and, of a site whose traffic was recorded, its trace.

    Attributes:
        arrivals: shape ``(at least T, J)``, packets that arrive in each step at each sensor; ``None``: Poisson.
    """

    scenario: Scenario
    arrivals: IntArray | None = None

    def world(self, cost: Cost = "default", render_mode: str | None = None) -> PipelineWorld:
        """A new world on this site."""
        return PipelineWorld(self.scenario, arrivals=self.arrivals, cost=cost, render_mode=render_mode)
