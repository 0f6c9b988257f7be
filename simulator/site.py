"""Where a mission is flown: a scenario, and the arrivals if they were recorded rather than drawn."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shared.scenario import Scenario, scenario_named
from simulator.record import BadUse

# The world takes a second to import, and pyproj a tenth: commands answer `--help` and bad use without them.
if TYPE_CHECKING:
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
        from simulator.world import PipelineWorld

        return PipelineWorld(self.scenario, arrivals=self.arrivals, cost=cost, render_mode=render_mode)


def chosen_site(scenario: str | None, world: Path | None, steps: int | None = None) -> Site:
    """The site that a command's options name; with neither a scenario nor a world, the scenario ``paper``.

    What is odd about a world but no error, such as a sensor that no UAV can reach, is told on stderr.

    Args:
        scenario: ``--scenario``, a preset's name.
        world: ``--world``, a folder as :mod:`simulator.worldfiles` describes it.
        steps: ``--steps``, instead of the scenario's or the world's.

    Raises:
        BadUse: both a scenario and a world, an option out of bounds, or a world's file that is missing or broken.
    """
    if world is None:
        return Site(chosen_scenario(scenario or "paper", steps))
    if scenario is not None:
        raise BadUse(f"--scenario {scenario[:32]} and --world {world} contradict each other; give one of the two")
    if steps is not None and not 1 <= steps <= 10_000:
        raise BadUse(f"--steps {steps} is not between 1 and 10000")
    from simulator.worldfiles import site_from_folder

    return site_from_folder(world, steps, on_warning=lambda text: print(f"warning: {text}", file=sys.stderr))


def chosen_scenario(name: str, steps: int | None = None) -> Scenario:
    """The preset, with other ``steps`` if given; raises ``BadUse``."""
    try:
        scenario = scenario_named(name)
        return scenario if steps is None else Scenario.model_validate({**scenario.model_dump(), "steps": steps})
    except ValueError as error:
        known = not str(error).startswith("unknown scenario")
        raise BadUse(f"--steps {steps} is not between 1 and 10000" if known else f"--scenario: {error}") from None
