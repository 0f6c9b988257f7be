"""Several missions on one embedded LLM, at the pace of the paper's world: the LLM's share of the decisions.

    python -m lab.benchmarks.llm_missions                 # four missions of three UAVs, a step in 10 s: five minutes
    python -m lab.benchmarks.llm_missions --step-s 2.5    # closer to the LLM's limit

It starts an edge in mode ``llm`` with the adapter that ships, and flies the missions in real time. All missions begin
each step at the same moment, the worst case, and a mission's UAVs ask one after the other. It prints the decisions by
source and reason, and their round trips, and writes the same as JSON. The share of the LLM is a count of decisions:
missed deadlines are at the edge's default deadline of 3 s.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from shared.client.edge_client import EdgeClient
from shared.wire.schemas import Mode
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import fly
from simulator.flying.local_edge import HOST, edge_process, usable_port
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.records.flight import Flight
from simulator.sites.site import Site


@dataclass(frozen=True)
class Missions:
    """Fly several missions at once on one embedded LLM."""

    missions: int = 4
    """Missions at once."""
    steps: int = 30
    """Steps of each."""
    step_s: float = 10.0
    """Seconds from one step to the next; a step that takes longer delays the ones after it."""
    mode: Mode = "llm"
    """The missions' mode."""
    scenario: str = "paper"
    """The world, by name; seed N is mission N's."""
    out: Path = Path("runs/llm-missions.json")
    """Where to write the figures."""


def flown(
    url: str, scenario: Scenario, seed: int, args: Missions, began: float, progress: Progress
) -> list[PilotChoice]:
    """All decisions of one mission, flown in real time from ``began`` (a time of the monotonic clock) on."""
    choices: list[PilotChoice] = []
    task = progress.add_task(f"mission {seed}", total=scenario.steps)

    def wait(flight: Flight) -> None:
        progress.update(task, completed=flight.steps_flown)
        time.sleep(max(0.0, began + flight.steps_flown * args.step_s - time.monotonic()))

    with EdgeClient(url, timeout_s=30) as client:
        pilot = EdgePilot(client, f"mission-{seed}", scenario, seed, mode=args.mode)
        client.put_mission(f"mission-{seed}", pilot.spec)
        time.sleep(max(0.0, began - time.monotonic()))
        fly(Site(scenario), pilot, seed, on_decision=choices.append, on_step=wait)
    return choices


def figures(choices: list[PilotChoice]) -> dict[str, object]:
    """Counts by source and reason, and round trips in seconds."""
    trips = np.array([choice.exchange.rtt_ms for choice in choices if choice.exchange]) / 1e3
    sources = Counter(f"{choice.source} ({choice.reason})" if choice.reason else choice.source for choice in choices)
    own = sum(choice.source in ("llm", "guided") for choice in choices)
    return {
        "decisions": len(choices),
        "sources": dict(sources.most_common()),
        "llm_share": round(own / len(choices), 4),
        "round_trip_s": {name: round(float(np.quantile(trips, q)), 3) for name, q in (("p50", 0.5), ("p99", 0.99))},
        "round_trip_s_max": round(float(trips.max()), 3),
    }


def main() -> int:
    """Fly, and print and write the figures; returns the exit code."""
    args, console = tyro.cli(Missions, description=__doc__), Console()
    scenario = SCENARIOS[args.scenario].model_copy(update={"steps": args.steps})
    port = usable_port(0)
    url = f"http://{HOST}:{port}"
    environment = {**os.environ, "AICVDS_STORE": "none", "AICVDS_MODE": args.mode}
    with tempfile.TemporaryDirectory() as folder, edge_process(port, Path(folder) / "edge.log", environment):
        with EdgeClient(url) as client:
            client.wait_ready(120)
        began = time.monotonic() + 2.0
        with Progress(console=console) as progress, ThreadPoolExecutor(args.missions) as pool:
            flights = [pool.submit(flown, url, scenario, seed, args, began, progress) for seed in range(args.missions)]
            choices = [choice for flight in flights for choice in flight.result()]
    found = figures(choices)
    for name, figure in found.items():
        console.print(f"{name:>18}  {figure}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    options = {name: getattr(args, name) for name in ("missions", "steps", "step_s", "mode", "scenario")}
    args.out.write_text(json.dumps(options | found, indent=2) + "\n")
    console.print(f"wrote {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
