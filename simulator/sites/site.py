"""A site: a scenario, and what was recorded of it rather than drawn: arrivals, excess losses of the links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from shared.scenario import Scenario

# The world takes a second to import, and pyproj a tenth: commands answer `--help` and bad use without them.
if TYPE_CHECKING:
    from shared.channel import IntArray
    from simulator.world import Cost, PipelineWorld
    from simulator.world.gain_trace import GainTrace


@dataclass(frozen=True, eq=False)
class Site:
    """A scenario and its recorded traces, if any.

    Attributes:
        arrivals: shape ``(at least T, J)``, packets that arrive in each step at each sensor; ``None`` for Poisson
            arrivals.
        gains: excess losses along the UAVs' ways, beside the scenario's.
    """

    scenario: Scenario
    arrivals: IntArray | None = None
    gains: GainTrace | None = None

    def world(self, cost: Cost = "default", render_mode: str | None = None) -> PipelineWorld:
        """A new world on this site."""
        from simulator.world import PipelineWorld

        return PipelineWorld(
            self.scenario, arrivals=self.arrivals, gains=self.gains, cost=cost, render_mode=render_mode
        )
