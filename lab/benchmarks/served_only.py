"""The losses of UAVs that observe only the sensor that they serve, as in the paper's protocol.

    python -m lab.benchmarks.served_only

It flies scenario `paper` with beacons and without (`observation_model: served`), in the same worlds, over an edge
without an LLM: mode `policy`, mode `value` on the fleet's belief, and mode `value` on each UAV's own reports with the
paper's features. It prints each one's lost packets and the ratio of the two, with 95% bootstrap intervals over worlds,
and writes each world's as CSV. A world takes some twenty seconds.
"""

from __future__ import annotations

import csv
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.progress import track

from lab.experiments.edges import Llm, edge_for
from lab.experiments.execution import commit
from lab.experiments.intervals import interval, paired
from lab.experiments.schemes import OFF
from shared.client.edge_client import EdgeClient
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot
from simulator.sites.site import Site

PAPER = SCENARIOS["paper"]
WORLDS = {"beacons": PAPER, "served": PAPER.model_copy(update={"observation_model": "served"})}
MODES: dict[str, dict[str, Any]] = {
    "policy": {"mode": "policy"},
    "value": {"mode": "value"},
    "value_reported": {"mode": "value", "features": "paper", "belief": "reported"},
}


@dataclass(frozen=True)
class ServedOnly:
    """Fly with beacons and without."""

    seeds: int = 30
    """Worlds: seeds 0 to N - 1."""
    steps: int = PAPER.steps
    """Steps of a mission."""
    out: Path = Path("runs/served-only.csv")
    """Where to write each world's losses."""


def flown(url: str, scenario: Scenario, seed: int, name: str, spec: dict[str, Any]) -> int:
    """The packets lost in one world."""
    with EdgeClient(url, timeout_s=60.0) as client:
        pilot = EdgePilot(client, name, scenario, seed, deadline_ms=30_000)
        pilot.spec = pilot.spec.model_copy(update=spec)
        client.put_mission(name, pilot.spec)
        tally = fly(Site(scenario), pilot, seed).tally
        client.delete_mission(name)
    return sum(step.lost_packets for step in tally)


def main(args: ServedOnly) -> None:
    """Fly, print, write."""
    console = Console()
    lost: dict[str, list[float]] = {f"{mode}@{world}": [] for mode in MODES for world in WORLDS}
    with (
        tempfile.TemporaryDirectory() as folder,
        edge_for(OFF, Llm("none"), Path(folder) / "edge.log", console) as edge,
    ):
        for seed in track(range(args.seeds), "Flying", console=console):
            for mode, spec in MODES.items():
                for world, scenario in WORLDS.items():
                    short = scenario.model_copy(update={"steps": args.steps})
                    lost[f"{mode}@{world}"].append(flown(edge.url, short, seed, f"{mode}-{world}-{seed}", spec))
    for name, values in lost.items():
        found = interval(values)
        console.print(f"{name}: {found.mean:.1f} [{found.low:.1f}, {found.high:.1f}]")
    for mode in MODES:
        for pair in paired(mode, "beacons", "lost_packets", lost[f"{mode}@served"], lost[f"{mode}@beacons"]):
            console.print(f"{mode}, served to beacons, {pair.kind}: {pair.mean:.2f} [{pair.low:.2f}, {pair.high:.2f}]")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("experiment", "scenario", "scheme", "seed", "measure", "value", "commit"))
        for name, values in lost.items():
            mode, world = name.split("@")
            for seed, value in enumerate(values):
                table.writerow(("served-only", PAPER.name, mode, seed, f"lost_packets@{world}", value, commit()))


if __name__ == "__main__":
    main(tyro.cli(ServedOnly, description=__doc__))
