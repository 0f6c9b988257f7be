"""The calibration of the planner's link probabilities: how often such links hold.

    python -m lab.benchmarks.link_calibration
    python -m lab.benchmarks.link_calibration --worlds 4 --scenario faulty

It flies `mpc`, the planner on board, in worlds of `shadowed`. At each decision it takes the probabilities of the UAV's
links to the sensors of the plan, one for each velocity of the next step, and looks up whether these links hold in the
world. It prints, for each tenth of the probabilities, the mean probability and the share of the links that hold, with
its 95% bootstrap interval over worlds, and writes a CSV line for each world and tenth. A world takes some three
seconds.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from lab.experiments.informed_planner import true_links_of_plan
from lab.experiments.intervals import paired
from shared.planning.receding import Draft
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario, scenario_named
from simulator.flying.flight import rollout
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld

TENTHS = 10
# The columns of a world's counts: links, the sum of their probabilities, links that hold.
LINKS, EXPECTED, HOLD = range(3)


@dataclass(frozen=True)
class Calibration:
    """Compare the planner's probabilities with the links of the world."""

    worlds: int = 30
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 500
    """The first seed."""
    scenario: str = "shadowed"
    """The world: shadowed, fading, faulty, field and others."""
    out: Path = Path("runs/link_calibration.csv")
    """Where to write the counts."""


class Comparing(RecedingHorizonPolicy):
    """The planner on board; it counts the links that hold, by the probability that it gives them.

    Args:
        world: in the state that the decisions are for.

    Attributes:
        counts: shape ``(10, 3)``, by tenth the links, the sum of their probabilities, and the links that hold.
    """

    def __init__(self, world: PipelineWorld) -> None:
        self._world = world
        self.counts: FloatArray = np.zeros((TENTHS, 3))

    def draft(self, uav: int, taken: frozenset[int]) -> Draft | None:
        """The draft; its probabilities of the next step are counted."""
        draft = super().draft(uav, taken)
        if draft is not None and draft.problem.chances is not None:
            column, levels = draft.uavs.index(uav), draft.problem.levels
            # The last column is the sensor that is nowhere.
            chances = draft.problem.chances[column][0, levels, :-1]
            holds = true_links_of_plan(self._world, draft)[column][0, levels, :-1] > 0
            possible = chances > 0
            tenth = np.minimum((chances[possible] * TENTHS).astype(int), TENTHS - 1)
            for index, values in enumerate((np.ones_like(chances), chances, holds)):
                self.counts[:, index] += np.bincount(tenth, values[possible], TENTHS)
        return draft


def counted(scenario: Scenario, seed: int) -> FloatArray:
    """The counts of one world's flight."""
    world = Site(scenario).world()
    world.reset(seed=seed)
    policy = Comparing(world)
    for _ in rollout(world, policy, seed):
        pass
    return policy.counts


def main(args: Calibration) -> int:
    """Fly, print, write."""
    console, scenario = Console(), scenario_named(args.scenario)
    seeds = range(args.first, args.first + args.worlds)
    found = np.stack([counted(scenario, seed) for seed in track(seeds, scenario.name, console=console)])
    console.print(f"{found[..., LINKS].sum():,.0f} links of {args.worlds} worlds of {scenario.name}", highlight=False)
    for tenth in range(TENTHS):
        links, expected, held = found[:, tenth].T
        if links.any():
            pairs = paired("hold", "links", "share", held.tolist(), links.tolist())
            share = next(pair for pair in pairs if pair.kind == "ratio")
            console.print(
                f"{tenth / TENTHS:.1f} to {(tenth + 1) / TENTHS:.1f}: {links.sum():,.0f} links, mean probability "
                f"{expected.sum() / links.sum():.2f}, {share.mean:.2f} [{share.low:.2f}, {share.high:.2f}] hold",
                highlight=False,
            )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["scenario", "seed", "from", "links", "expected_to_hold", "hold"])
        for seed, world in zip(seeds, found, strict=True):
            for tenth, (links, expected, held) in enumerate(world):
                writer.writerow([scenario.name, seed, tenth / TENTHS, int(links), round(expected, 3), int(held)])
    console.print(f"Wrote {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Calibration, description=__doc__)))
