"""A site: a scenario, and its recorded arrivals and excess losses of the links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from shared.world.scenario import Scenario

# The world takes a second to import, and pyproj a tenth: commands answer `--help` and bad use without them.
if TYPE_CHECKING:
    from shared.wire.names import MapShape, Names
    from shared.wire.schemas import MissionSpec
    from shared.world.channel import IntArray
    from simulator.sites.fence import Fence
    from simulator.sites.projection import Frame
    from simulator.world.environment import PipelineWorld
    from simulator.world.gain_trace import GainTrace


@dataclass(frozen=True, eq=False)
class Site:
    """A scenario and its recorded traces, if any.

    Attributes:
        arrivals: shape ``(at least T, J)``, packets that arrive in each step at each sensor; ``None`` for Poisson
            arrivals.
        gains: excess losses along the UAVs' paths, added to the scenario's.
        frame: the place of the scenario's plane on the globe; ``None`` for a site that has none.
        sensor_names: the sensors' IDs on the globe, ``()`` for a site that has none.
        fences: areas that no UAV may leave or enter, metres in the scenario's plane.
        names, map: for people, as in a mission's spec.
    """

    scenario: Scenario
    arrivals: IntArray | None = None
    gains: GainTrace | None = None
    frame: Frame | None = None
    sensor_names: tuple[str, ...] = ()
    fences: tuple[Fence, ...] = ()
    names: Names | None = None
    map: tuple[MapShape, ...] = ()

    def named(self, spec: MissionSpec) -> MissionSpec:
        """The spec with the site's names and map."""
        return spec.model_copy(update={"names": self.names, "map": list(self.map) or None})

    def world(self) -> PipelineWorld:
        """A new world on this site."""
        from simulator.world.environment import PipelineWorld

        return PipelineWorld(self.scenario, arrivals=self.arrivals, gains=self.gains)
