"""Decisions a second of ``aicvds serve --ray local`` to those of plain ``aicvds serve``, side by side.

    python benchmarks/ray_serve.py

Both have as many deciding processes, mode ``value``, and databases of their own on one PostgreSQL. In every round each
is measured in turn, the one or the other first: with one UAV, for the time of a decision, and with many at once, for
decisions a second. Each UAV keeps its connection and sends the last decision's outcome with its report. It prints
medians over rounds, and ratios with 95% bootstrap intervals over rounds, and writes the same as JSON. PostgreSQL and
what makes the load run on the same cores.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import psycopg
import tyro
from capacity import Database
from processes import Edge, load, made
from ratios import ratio_of_medians, shown
from rich.console import Console
from rich.table import Table

from simulator.flying.local_edge import edge_process, usable_port

QUANTITIES = ("alone_p50", "rate", "p50", "p99")


@dataclass(frozen=True)
class RayServe:
    """Put load on plain edges and on edges on Ray."""

    rounds: int = 8
    """Rounds; each measures both."""
    seconds: float = 3.0
    """Seconds of each measurement."""
    uavs: int = 16
    """Concurrent UAVs, each with a mission of its own."""
    edges: int = 1
    """Deciding processes: edges on Ray, and `--processes` without it."""
    out: Path = Path("runs/ray_serve.json")
    """Where to write the figures."""


def start(args: RayServe, folder: Path, database: Database, stack: ExitStack) -> dict[str, Edge]:
    """Both, ready."""
    ways = {
        "plain": ["--processes", str(args.edges)],
        "ray": ["--ray", "local", "--replicas", str(args.edges)],
    }
    edges = {}
    for way, options in ways.items():
        with psycopg.connect(database.url, autocommit=True) as db:
            db.execute(f"CREATE DATABASE {way}")
        settings = {
            "AICVDS_MODE": "value",
            "AICVDS_LOG_LEVEL": "error",
            "AICVDS_STORE": database.url.replace("/postgres?", f"/{way}?"),
        }
        port = usable_port(0)
        process = stack.enter_context(edge_process(port, folder / f"{way}.log", {**os.environ, **settings}, options))
        edges[way] = Edge(args.edges, way, psutil.Process(process.pid), port, made(port, args.uavs))
    return edges


def measured(edge: Edge, args: RayServe) -> dict[str, float]:
    """Milliseconds of a decision of one UAV alone; with all: decisions a second, p50 and p99."""
    found = {}
    for name, uavs in (("alone", 1), ("many", args.uavs)):
        ends = time.perf_counter() + args.seconds
        took_ms, lasted = load(edge, "kept", uavs, lambda ends=ends: time.perf_counter() >= ends)  # type: ignore[misc]
        found[name] = (len(took_ms) / lasted, *np.percentile(took_ms, [50, 99]))
    rate, p50, p99 = found["many"]
    return {"alone_p50": float(found["alone"][1]), "rate": rate, "p50": float(p50), "p99": float(p99)}


def main(args: RayServe) -> None:
    """Measure, print, write."""
    console = Console()
    figures: dict[str, dict[str, list[float]]] = {way: {q: [] for q in QUANTITIES} for way in ("plain", "ray")}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        database = stack.enter_context(closing(Database(folder / "postgres")))
        with console.status("starting"):
            edges = start(args, folder, database, stack)
        for number in range(args.rounds + 1):
            for way in edges if number % 2 else reversed(edges):
                once = measured(edges[way], args)
                # The first round warms up.
                for quantity, value in once.items() if number else ():
                    figures[way][quantity].append(value)
    ratios = {q: ratio_of_medians(figures["ray"][q], figures["plain"][q]) for q in ("rate", "alone_p50")}
    medians = {way: {q: round(float(np.median(v)), 3) for q, v in found.items()} for way, found in figures.items()}
    tell(console, medians, ratios, args)
    result: dict[str, Any] = {"command": sys.argv, "edges": args.edges, "medians": medians, "ratios": ratios}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=1) + "\n")


def tell(
    console: Console, medians: dict[str, dict[str, float]], ratios: dict[str, list[float]], args: RayServe
) -> None:
    """Print the medians and the ratios."""
    table = Table("", "one UAV: p50 ms", f"{args.uavs} UAVs: decisions/s", "p50 ms", "p99 ms")
    for way, found in medians.items():
        table.add_row(way, *(f"{found[quantity]:.2f}" for quantity in QUANTITIES))
    console.print(table)
    console.print(f"{args.edges} edges on Ray decide {shown(ratios['rate'])} times as often as without Ray;")
    console.print(f"a UAV alone waits {shown(ratios['alone_p50'])} times as long.")


if __name__ == "__main__":
    main(tyro.cli(RayServe, description=__doc__))
