"""The time of a decision with the planner on, in modes ``policy`` and ``guided``, beside another commit's.

    python benchmarks/planning.py
    python benchmarks/planning.py --before DIR --worlds 30

It flies every world on `aicvds serve` in a process of its own, with missions in memory and an LLM that draws a letter
at once, so that the LLM's time does not count. ``--before`` names another checkout of this repository with its virtual
environment in ``.venv``: its edge flies the same worlds in turn with this one's, so that a noisy machine is noisy for
both. A decision's time is the round trip of its request, which has the outcome of the UAV's last decision. It prints
each edge's median and 95th percentile, the processor time of a decision, and the lost packets, with their ratios to the
other edge's and 95% bootstrap intervals over worlds, and writes the same as JSON. On two busy cores a mission
took 14 s on average.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from overhead import edge_of
from processor_time import processor_s
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from lab.experiments.intervals import interval, paired
from lab.experiments.stand_ins import answering, drawn
from shared.client.edge_client import EdgeClient
from shared.wire.schemas import Mode
from simulator.commands.options import site_from_options
from simulator.flying.flight import fly
from simulator.flying.local_edge import HOST
from simulator.flying.pilots import EdgePilot

QUANTITIES = {"p50_ms": "p50, ms", "p95_ms": "p95, ms", "cpu_ms": "processor ms a decision", "lost": "lost packets"}
# No clock ends a search: how much a plan loses is not to depend on the machine.
SETTINGS = {"AICVDS_STORE": "none", "AICVDS_LOG_LEVEL": "warning", "AICVDS_PLANNER_MS": "30000"}
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Planning:
    """Time decisions with the planner on."""

    worlds: int = 10
    """Worlds of each scenario: seeds --first to --first + N - 1."""
    first: int = 0
    """The first seed."""
    scenarios: tuple[str, ...] = ("paper", "shadowed")
    """Scenarios: in the first every link is as the formula has it."""
    modes: tuple[Mode, ...] = ("policy", "guided")
    """Modes of the missions."""
    before: Path | None = None
    """Another checkout, whose edge flies the same worlds."""
    out: Path = Path("runs/planning.json")
    """Where to write the figures."""


def flown(edge: tuple[int, int], scenario: str, mode: Mode, seed: int) -> dict[str, float]:
    """One mission's quantities, on the edge of this process and port; raises ``SystemExit`` where it left one out."""
    process, port = edge
    site, name = site_from_options(scenario, None), f"{scenario}-{mode}-{seed}"
    busy_s = processor_s(process)
    with EdgeClient(f"http://{HOST}:{port}", timeout_s=PATIENCE_S) as client:
        pilot = EdgePilot(client, name, site.scenario, seed)
        pilot.spec = pilot.spec.model_copy(update={"mode": mode})
        client.put_mission(name, pilot.spec)
        flight = fly(site, pilot, seed)
    took_ms = [decision.rtt_ms for decision in flight.decisions if decision.rtt_ms is not None]
    if len(took_ms) < len(flight.decisions):
        raise SystemExit(f"{name}: the edge did not answer every request: {pilot.last_error}")
    p50, p95 = np.percentile(took_ms, [50, 95]).tolist()
    cpu = (processor_s(process) - busy_s) * 1e3 / len(took_ms)
    lost = float(sum(step.lost_packets for step in flight.tally))
    return {"p50_ms": p50, "p95_ms": p95, "cpu_ms": cpu, "lost": lost}


def rows_of(scenario: str, mode: Mode, found: dict[str, list[dict[str, float]]]) -> list[dict[str, Any]]:
    """Each edge's means over worlds, and their ratios to the first edge's, which is the other commit's."""
    rows = []
    first = next(iter(found))
    for name, worlds in found.items():
        row: dict[str, Any] = {"scenario": scenario, "mode": mode, "edge": name}
        for quantity in QUANTITIES:
            mine, its = ([world[quantity] for world in flights] for flights in (worlds, found[first]))
            row[quantity] = interval(mine).model_dump()
            if name != first:
                pair = next(p for p in paired(name, first, quantity, mine, its) if p.kind == "ratio")
                row[f"{quantity} to {first}"] = [round(value, 3) for value in (pair.mean, pair.low, pair.high)]
        rows.append(row)
    return rows


def tell(rows: list[dict[str, Any]], console: Console) -> None:
    """Print the rows."""
    table = Table("scenario", "mode", "edge", *QUANTITIES.values())
    for row in rows:
        cells = []
        for quantity in QUANTITIES:
            ratio = next((row[key] for key in row if key.startswith(f"{quantity} to ")), None)
            cell = f"{row[quantity]['mean']:.1f}"
            cells.append(cell if ratio is None else f"{cell} = {ratio[0]:.2f} [{ratio[1]:.2f}, {ratio[2]:.2f}]")
        table.add_row(row["scenario"], row["mode"], row["edge"], *cells)
    console.print(table)


def main(options: Planning) -> None:
    """Fly, print, write."""
    console, rows = Console(), []
    checkouts = {} if options.before is None else {"before": options.before.absolute()}
    with ExitStack() as stack:
        settings = {**SETTINGS, "AICVDS_LLM_URL": stack.enter_context(answering(drawn))}
        edges = {name: edge_of(settings, stack, folder) for name, folder in {**checkouts, "this": None}.items()}
        progress = stack.enter_context(Progress(console=console))
        every = len(options.scenarios) * len(options.modes) * options.worlds * len(edges)
        task = progress.add_task("flying", total=every)
        for scenario in options.scenarios:
            for mode in options.modes:
                found: dict[str, list[dict[str, float]]] = {name: [] for name in edges}
                for seed in range(options.first, options.first + options.worlds):
                    for name, edge in edges.items():
                        found[name].append(flown(edge, scenario, mode, seed))
                        progress.advance(task)
                rows += rows_of(scenario, mode, found)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(
        json.dumps({"worlds": options.worlds, "first": options.first, "rows": rows}, indent=2) + "\n"
    )
    tell(rows, console)


if __name__ == "__main__":
    main(tyro.cli(Planning, description=__doc__))
