"""The losses of planners that know more of a shadowed world's channel than its beacons show.

    python -m lab.benchmarks.known_channel
    python -m lab.benchmarks.known_channel --worlds 20

It flies `mpc`, the planner on board, in worlds of `shadowed`. `known_kind` is `mpc` that knows how much of the variance
is a sensor's own and how much changes along the way, and over which distance: the radio map need not choose.
`known_own` also knows each sensor's own excess loss and the deviation along the way, so that it learns the shadowing
along the way alone. `true_links` knows every link to come. No UAV could fly these three. It prints each one's lost
packets, those of the first ten steps, and the ratios to `mpc` and to `true_links`, with 95% bootstrap intervals over
worlds, and writes the same as JSON. A world takes some ten seconds.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import ArrayLike
from rich.console import Console
from rich.progress import track

from lab.experiments.informed_planner import InformedPlanner
from lab.experiments.intervals import interval, paired
from shared.belief.fleet_belief import FleetBelief
from shared.belief.radio_map import RadioMap
from shared.belief.shadowing import Shadowing
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario, scenario_named
from simulator.flying.flight import rollout
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.policies.registry import Policy
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld

EARLY_STEPS = 10
# Without any fading a second measurement at one place would divide by zero.
FADING = 0.002


@dataclass(frozen=True)
class Known:
    """Fly planners with increasing knowledge of the channel."""

    worlds: int = 120
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 500
    """The first seed."""
    out: Path = Path("runs/known_channel.json")
    """Where to write the figures."""


class KindKnown(RadioMap):
    """A radio map with a given kind of shadowing; it learns the offset and the deviation.

    Args:
        sensors: J.
        kind: of the shadowing.
    """

    def __init__(self, sensors: int, kind: Shadowing) -> None:
        super().__init__(sensors)
        self.kind = kind

    def _compare(self) -> None:
        self._factor(np.flatnonzero(self.count))


class OwnKnown(KindKnown):
    """A radio map that knows each sensor's own excess loss, and learns the shadowing along the way.

    Args:
        own_db: shape ``(J,)``, each sensor's own excess loss, dB.
        scenario: gives the shadowing along the way.
    """

    def __init__(self, own_db: FloatArray, scenario: Scenario) -> None:
        super().__init__(len(own_db), Shadowing(0.0, 1.0 - FADING, scenario.decorrelation_m))
        self._own_db, self._along_db = own_db, scenario.route_shadowing_db
        self.exact = False
        self._factor(np.arange(len(own_db)))

    def measure(self, ids: IntArray, place: ArrayLike, excess_db: FloatArray) -> FloatArray:
        """Take measurements as :class:`RadioMap` does."""
        own_db = self._own_db[ids]
        return super().measure(ids, place, excess_db - own_db) + own_db

    def predict(self, places: FloatArray, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """Predict as :class:`RadioMap` does."""
        mean, deviation = super().predict(places, which)
        return mean + self._own_db[which], deviation

    def _estimate(self) -> None:
        self.offset_db, self.deviation_db = 0.0, self._along_db


class MapGiven(RecedingHorizonPolicy):
    """The planner on board with a given radio map.

    Args:
        radio_map: makes the map of a mission.
    """

    def __init__(self, radio_map: Callable[[], RadioMap]) -> None:
        self._radio_map = radio_map

    def new_belief(self, scenario: Scenario) -> FleetBelief:
        """A belief with that map."""
        belief = super().new_belief(scenario)
        belief.channel.radio_map = self._radio_map()
        return belief


def schemes(world: PipelineWorld) -> dict[str, Policy]:
    """The planners for a world that is reset with its seed."""
    scenario, own_db = world.scenario, world.truth.channel.own_db
    own, along = scenario.shadowing_db**2, scenario.route_shadowing_db**2
    share = (1.0 - FADING) / (own + along)
    kind = Shadowing(own * share, along * share, scenario.decorrelation_m)
    return {
        "mpc": RecedingHorizonPolicy(),
        "known_kind": MapGiven(lambda: KindKnown(scenario.sensors, kind)),
        "known_own": MapGiven(lambda: OwnKnown(own_db, scenario)),
        "true_links": InformedPlanner(world),
    }


def flown(scenario: Scenario, seed: int) -> dict[str, list[int]]:
    """The packets lost in each step of one world, by scheme."""
    world = Site(scenario).world()
    world.reset(seed=seed)
    return {
        name: [int(step.lost_packets) for step in rollout(world, scheme, seed)]
        for name, scheme in schemes(world).items()
    }


def print_rows(found: list[dict[str, list[int]]], console: Console) -> list[dict[str, Any]]:
    """Print and return each scheme's row."""
    lost = {name: [float(sum(world[name])) for world in found] for name in found[0]}
    rows: list[dict[str, Any]] = []
    for name, packets in lost.items():
        early = float(np.mean([sum(world[name][:EARLY_STEPS]) for world in found]))
        row = {
            "scheme": name,
            "lost": interval(packets).model_dump(),
            "early": early,
            "steps": [w[name] for w in found],
        }
        text = f"{name}: {np.mean(packets):.1f} lost, {early:.1f} of them in the first {EARLY_STEPS} steps"
        for other in ("mpc", "true_links"):
            for pair in paired(name, other, "lost_packets", packets, lost[other]):
                row[f"{pair.kind} to {other}"] = [pair.mean, pair.low, pair.high]
                if pair.kind == "ratio" and name != other:
                    text += f"; {pair.mean:.2f} [{pair.low:.2f}, {pair.high:.2f}] times {other}"
        console.print(text, highlight=False, soft_wrap=True)
        rows.append(row)
    return rows


def main(args: Known) -> int:
    """Fly, print, write."""
    console, scenario = Console(), scenario_named("shadowed")
    seeds = range(args.first, args.first + args.worlds)
    found = [flown(scenario, seed) for seed in track(seeds, scenario.name, console=console)]
    rows = print_rows(found, console)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"seeds": list(seeds), "rows": rows}, indent=2))
    console.print(f"Wrote {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Known, description=__doc__)))
