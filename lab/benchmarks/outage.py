"""The losses of an outage of the edge, by the velocity of the UAVs during the outage.

    python -m lab.benchmarks.outage

It flies scenario `pipeline` with UAVs of at most 11 m/s over an edge in mode `policy`, in the same worlds: without an
outage, and with one of four steps in mid-mission, in which the UAVs fly at 7 m/s, wait in place, or go on at the
velocity that the edge decided last, as they do. It prints each one's lost packets and the ratios to the flight without
outage, with 95% bootstrap intervals over worlds, and writes the same as JSON. A world takes some ten seconds.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import track

from lab.experiments.edges import Llm, edge_for
from lab.experiments.intervals import interval, paired
from lab.experiments.schemes import OFF
from shared.client.calls import Exchange
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeUnreachable
from shared.wire.schemas import DecideRequest
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, OnBoard
from simulator.sites.site import Site

VARIANTS = ("none", "7 m/s", "in place", "last decided")


@dataclass(frozen=True)
class Outage:
    """Fly with and without an outage."""

    seeds: int = 20
    """Worlds: seeds 0 to N - 1."""
    steps: int = 30
    """Steps of a mission; the outage begins in the middle."""
    outage: int = 4
    """Steps of the outage."""
    scenario: str = "pipeline"
    """The world."""
    out: Path = Path("runs/outage.json")
    """Where to write the figures."""


class Constant(OnBoard):
    """Flies at one velocity, whatever the edge decided."""

    velocity = 7

    def follow(self, uav: int, velocity: int) -> None:
        """Remember the one velocity."""
        super().follow(uav, self.velocity)


class InPlace(Constant):
    """Waits in place."""

    velocity = 0


ON_BOARD = {"7 m/s": Constant, "in place": InPlace, "last decided": OnBoard}


class CutOffClient(EdgeClient):
    """A client that does not reach the edge in the steps ``outage``."""

    outage = range(0)

    def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
        """Request a decision; raises ``EdgeUnreachable`` during the outage."""
        if request.step in self.outage:
            raise EdgeUnreachable("the outage of this benchmark")
        return super().decide(request, attempts)


def flown(url: str, scenario: Scenario, seed: int, variant: str, outage: int) -> int:
    """The packets lost in one world."""
    name = f"{VARIANTS.index(variant)}-{seed}"
    with CutOffClient(url, timeout_s=60.0) as client:
        pilot = EdgePilot(client, name, scenario, seed, mode="policy", deadline_ms=30_000)
        client.put_mission(name, pilot.spec)
        if variant != "none":
            client.outage = range(scenario.steps // 2 - 1, scenario.steps // 2 - 1 + outage)
            pilot.on_board = ON_BOARD[variant](scenario, seed)
        tally = fly(Site(scenario), pilot, seed).tally
        client.delete_mission(name)
    return sum(step.lost_packets for step in tally)


def main(args: Outage) -> None:
    """Fly, print, write."""
    console = Console()
    scenario = SCENARIOS[args.scenario].model_copy(update={"max_velocity": 11, "steps": args.steps})
    lost: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    with (
        tempfile.TemporaryDirectory() as folder,
        edge_for(OFF, Llm("none"), Path(folder) / "edge.log", console) as edge,
    ):
        for seed in track(range(args.seeds), "Flying", console=console):
            for variant in VARIANTS:
                lost[variant].append(flown(edge.url, scenario, seed, variant, args.outage))
    for name, values in lost.items():
        found = interval(values)
        console.print(f"{name}: {found.mean:.1f} [{found.low:.1f}, {found.high:.1f}]")
    for name in VARIANTS[1:]:
        for pair in paired(name, "none", "lost_packets", lost[name], lost["none"]):
            console.print(f"{name} to none, {pair.kind}: {pair.mean:.2f} [{pair.low:.2f}, {pair.high:.2f}]")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(lost, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Outage, description=__doc__))
