"""The time of a decision with the planner on, in modes ``policy`` and ``guided``, compared with another commit's.

    python -m benchmarks.planning
    python -m benchmarks.planning --before DIR --rounds 30

It flies every world on `aicvds serve` in a process of its own, with missions in memory and an LLM that draws a letter
at once, so that the LLM's time does not count. ``--before`` names another checkout of this repository with its virtual
environment in ``.venv``: its edge flies the same worlds in turn with this one's, so that a noisy machine is noisy for
both. A decision's time is the round trip of its request, which has the outcome of the UAV's last decision. It prints
each edge's median and 95th percentile, the processor time of a decision, and the lost packets, with their ratios to the
other edge's and 95% bootstrap intervals over worlds, and writes the same as JSON. On two busy cores a mission
took 14 s on average.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Options, Report, Rows, Server, edge, in_turn, run
from lab.experiments.intervals import interval, paired
from lab.experiments.stand_ins import answering, drawn
from shared.client.edge_client import EdgeClient
from shared.wire.schemas import Mode
from simulator.commands.options import site_from_options
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot

QUANTITIES = {"p50_ms": "p50, ms", "p95_ms": "p95, ms", "cpu_ms": "processor ms a decision", "lost": "lost packets"}
# No clock ends a search, so that the losses of a plan do not depend on the machine.
SETTINGS = {"STORE": "none", "PLANNER_MS": "30000"}
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Planning(Options):
    """Time decisions with the planner on."""

    rounds: int = 10
    """Worlds of each scenario: seeds --first to --first + N - 1."""
    first: int = 0
    """The first seed."""
    scenarios: tuple[str, ...] = ("paper", "shadowed")
    """Scenarios: in the first every link is as the formula has it."""
    modes: tuple[Mode, ...] = ("policy", "guided")
    """Modes of the missions."""
    before: Path | None = None
    """Another checkout, whose edge flies the same worlds."""


def flown(edge: Server, scenario: str, mode: Mode, seed: int) -> dict[str, float]:
    """One mission's quantities; raises ``SystemExit`` if an answer lacks one."""
    site, name = site_from_options(scenario, None), f"{scenario}-{mode}-{seed}"
    busy_s = edge.processor_s()
    with EdgeClient(edge.url, timeout_s=PATIENCE_S) as client:
        pilot = EdgePilot(client, name, site.scenario, seed)
        pilot.spec = pilot.spec.model_copy(update={"mode": mode})
        client.put_mission(name, pilot.spec)
        flight = fly(site, pilot, seed)
    took_ms = [decision.rtt_ms for decision in flight.decisions if decision.rtt_ms is not None]
    if len(took_ms) < len(flight.decisions):
        raise SystemExit(f"{name}: the edge did not answer every request: {pilot.last_error}")
    p50, p95 = np.percentile(took_ms, [50, 95]).tolist()
    cpu = (edge.processor_s() - busy_s) * 1e3 / len(took_ms)
    lost = float(sum(step.lost_packets for step in flight.tally))
    return {"p50_ms": p50, "p95_ms": p95, "cpu_ms": cpu, "lost": lost}


def rows_of(scenario: str, mode: Mode, found: dict[str, list[dict[str, float]]]) -> list[dict[str, Any]]:
    """Each edge's means over worlds, and their ratios to the first edge's, which is the other commit's."""
    rows = []
    first = next(iter(found))
    for name, worlds in found.items():
        row: dict[str, Any] = {"scenario": scenario, "mode": mode, "edge": name}
        for quantity in QUANTITIES:
            ours, theirs = ([world[quantity] for world in flights] for flights in (worlds, found[first]))
            row[quantity] = interval(ours).model_dump()
            if name != first:
                pair = next(p for p in paired(name, first, quantity, ours, theirs) if p.kind == "ratio")
                row[f"{quantity} to {first}"] = [round(value, 3) for value in (pair.mean, pair.low, pair.high)]
        rows.append(row)
    return rows


def table(rows: list[dict[str, Any]]) -> Rows:
    """Each edge's means, and its ratios to the other commit's."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        name = f"{row['scenario']}, {row['mode']}, {row['edge']}"
        found[name] = {label: row[quantity]["mean"] for quantity, label in QUANTITIES.items()}
        ratios = {label: row.get(f"{quantity} to before") for quantity, label in QUANTITIES.items()}
        found |= {f"{name} to before": ratios} if all(ratios.values()) else {}
    return found


def measure(options: Planning) -> Report:
    """Fly every world on each edge."""
    rows = []
    checkouts = {} if options.before is None else {"before": options.before}
    with ExitStack() as stack:
        settings = {**SETTINGS, "LLM_URL": stack.enter_context(answering(drawn))}
        edges = {name: stack.enter_context(edge(settings, at)) for name, at in {**checkouts, "this": None}.items()}
        for scenario in options.scenarios:
            for mode in options.modes:
                rows += rows_of(scenario, mode, worlds(edges, scenario, mode, options))
    return Report({"worlds": options.rounds, "first": options.first, "rows": rows}, {"Decisions": table(rows)})


def worlds(edges: dict[str, Server], scenario: str, mode: Mode, options: Planning) -> dict[str, list[dict[str, float]]]:
    """The quantities of each world by edge."""

    def flying(edge: Server) -> Callable[[int], dict[str, float]]:
        return lambda number: flown(edge, scenario, mode, options.first + number)

    return in_turn({name: flying(edge) for name, edge in edges.items()}, options.rounds)


if __name__ == "__main__":
    run(Planning, measure)
