"""Decisions a second of an edge with one deciding process and with two, side by side, and where processor time goes.

    python benchmarks/processes.py

Edges of mode ``value`` with 1,000 missions each, in SQLite and without a store, are started at once; only the one that
is measured has anything to do. 64 UAVs of as many missions each send their next request after each answer, with the
last decision's outcome. ``kept``: each UAV has one connection, as in a flight with less than 5 s between decisions.
``new``: each request has a connection of its own, as in a flight with more, and 64 workers go through all missions;
with two processes every second request arrives at the other one, and moves with its connection. Every round measures
all edges, in turn the one or the other first. It prints medians over rounds, ratios with 95% bootstrap intervals over
rounds, and processor time a decision: of the deciding processes, of those that write the store, of the load generator,
of everything else on the machine, and what was idle. It writes the same as JSON. The load generator runs on the same
cores.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tyro
import uvloop
from ratios import ratio_of_medians, shown
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from shared.client.edge_client import EdgeClient
from shared.wire.schemas import MissionSpec
from simulator.flying.local_edge import HOST, edge_process, usable_port

SENSORS = 10
GOAL = 1.6
TRAFFIC = ("kept", "new")
# Milliseconds of processor time a decision, by who spent it.
PARTS = ("deciding", "writing", "load", "others", "idle")
QUANTITIES = ("rate", "p50", "p99", *PARTS)


@dataclass(frozen=True)
class Processes:
    """Put load on edges with one deciding process and with more."""

    rounds: int = 10
    """Rounds; each measures every edge with both kinds of connections."""
    seconds: float = 3.0
    """Seconds of each measurement."""
    uavs: int = 64
    """Concurrent UAVs."""
    missions: int = 1000
    """Missions that each edge has in memory, at least one for each UAV."""
    processes: int = 2
    """Deciding processes of the edge beside that with one."""
    stores: tuple[str, ...] = ("sqlite", "none")
    """Stores to measure with."""
    out: Path = Path("runs/processes.json")
    """Where to write the figures."""


@dataclass
class Mission:
    """A mission of one UAV: its next step, and the decision whose outcome is not reported yet."""

    name: str
    step: int = 0
    owed: str | None = None
    chance: random.Random = field(default_factory=lambda: random.Random(0))

    def request(self, close: bool) -> bytes:
        """The next request with its head."""
        body: dict[str, Any] = {
            "mission_id": self.name,
            "uav_id": 0,
            "step": self.step,
            "position": [500.0, 450.0],
            "sensors": {
                "id": list(range(SENSORS)),
                "x": [100.0 * i for i in range(SENSORS)],
                "y": [90.0 * i for i in range(SENSORS)],
                "queue": [self.chance.randrange(60) for _ in range(SENSORS)],
                "battery": [40.0] * SENSORS,
                "channel_gain": [-90.0] * SENSORS,
                "last_seen": [self.step] * SENSORS,
            },
        }
        if self.owed is not None:
            body["outcome"] = {"decision_id": self.owed, "cost": 0.2, "failed": False}
        content = json.dumps(body).encode()
        ends = "Connection: close\r\n" if close else ""
        head = f"POST /decide HTTP/1.1\r\nHost: {HOST}\r\nContent-Type: application/json\r\n{ends}"
        return f"{head}Content-Length: {len(content)}\r\n\r\n".encode() + content

    def decided(self, answer: bytes) -> None:
        """Take the answer."""
        self.step, self.owed = self.step + 1, json.loads(answer)["decision_id"]


@dataclass
class Edge:
    """An edge under load: its number of deciding processes, its store, its parent process, port and missions."""

    processes: int
    store: str
    root: psutil.Process
    port: int
    missions: list[Mission]

    def busy_s(self) -> dict[str, float]:
        """Seconds of processor time until now by part."""
        first = self.root.children()
        deciding = [self.root, *first] if self.processes > 1 else [self.root]
        writing = [p for each in first for p in each.children()] if self.processes > 1 else first
        return {"deciding": _spent_s(deciding), "writing": _spent_s(writing)}


def _spent_s(processes: Sequence[psutil.Process]) -> float:
    times = [each.cpu_times() for each in processes]
    return float(sum(each.user + each.system for each in times))


async def _asked(streams: tuple[asyncio.StreamReader, asyncio.StreamWriter], mission: Mission, close: bool) -> None:
    reader, writer = streams
    writer.write(mission.request(close))
    head = await reader.readuntil(b"\r\n\r\n")
    length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
    answer = await reader.readexactly(length)
    if not head.startswith(b"HTTP/1.1 200"):
        raise SystemExit(f"processes: {answer[:500].decode()}")
    mission.decided(answer)


async def _keeps(port: int, mission: Mission, over: Callable[[], bool], took_ms: list[float]) -> None:
    """Fly one mission over one connection."""
    streams = await asyncio.open_connection(HOST, port)
    try:
        while not over():
            began = time.perf_counter()
            await _asked(streams, mission, close=False)
            took_ms.append((time.perf_counter() - began) * 1e3)
    finally:
        streams[1].close()


async def _connects(port: int, missions: Sequence[Mission], over: Callable[[], bool], took_ms: list[float]) -> None:
    """Fly missions in turn, each decision over a connection of its own."""
    for index in range(sys.maxsize):
        if over():
            return
        began = time.perf_counter()
        streams = await asyncio.open_connection(HOST, port)
        try:
            await _asked(streams, missions[index % len(missions)], close=True)
        finally:
            streams[1].close()
        took_ms.append((time.perf_counter() - began) * 1e3)


def load(edge: Edge, traffic: str, uavs: int, over: Callable[[], bool]) -> tuple[list[float], float]:
    """Put load on the edge until ``over``; returns each decision's milliseconds, and the seconds that it lasted."""

    async def fly() -> tuple[list[float], float]:
        took_ms = list[float]()
        began = time.perf_counter()
        if traffic == "kept":
            flights = [_keeps(edge.port, mission, over, took_ms) for mission in edge.missions[:uavs]]
        else:
            flights = [_connects(edge.port, edge.missions[uav::uavs], over, took_ms) for uav in range(uavs)]
        await asyncio.gather(*flights)
        return took_ms, time.perf_counter() - began

    return uvloop.run(fly())


def measured(edge: Edge, traffic: str, options: Processes) -> dict[str, float]:
    """Decisions a second, their p50 and p99 in ms, and the processor time a decision in ms by part."""
    before, machine, own = edge.busy_s(), psutil.cpu_times(), time.process_time()
    ends = time.perf_counter() + options.seconds
    took_ms, lasted = load(edge, traffic, options.uavs, lambda: time.perf_counter() >= ends)
    spent = {part: after - before[part] for part, after in edge.busy_s().items()}
    spent["load"] = time.process_time() - own
    now = psutil.cpu_times()
    spent["idle"] = now.idle + now.iowait - machine.idle - machine.iowait
    spent["others"] = lasted * (psutil.cpu_count() or 1) - sum(spent.values())
    p50, p99 = np.percentile(took_ms, [50, 99])
    a_decision = {part: spent[part] * 1e3 / len(took_ms) for part in PARTS}
    return {"rate": len(took_ms) / lasted, "p50": float(p50), "p99": float(p99), **a_decision}


def made(port: int, count: int) -> list[Mission]:
    """New missions of an edge, once it is ready."""
    missions = [Mission(f"mission-{number}") for number in range(count)]
    with EdgeClient(f"http://{HOST}:{port}", timeout_s=60) as client:
        client.wait_ready(120)
        for mission in missions:
            client.put_mission(mission.name, MissionSpec())
    return missions


def start(options: Processes, folder: Path, stack: ExitStack) -> list[Edge]:
    """Start the edges, and fly one decision of each mission."""
    edges = list[Edge]()
    for store in options.stores:
        for processes in (1, options.processes):
            port, name = usable_port(0), f"{store}-{processes}"
            settings = {
                "AICVDS_MODE": "value",
                "AICVDS_LOG_LEVEL": "error",
                "AICVDS_STORE": "none" if store == "none" else str(folder / f"{name}.db"),
                "AICVDS_MAX_MISSIONS": str(options.missions + 1),
                "AICVDS_PROCESSES": str(processes),
            }
            process = stack.enter_context(edge_process(port, folder / f"{name}.log", {**os.environ, **settings}))
            missions = made(port, options.missions)
            edges.append(Edge(processes, store, psutil.Process(process.pid), port, missions))
    for edge in edges:
        left = iter([*edge.missions, *[None] * options.uavs])
        load(edge, "new", options.uavs, lambda left=left: next(left) is None)  # type: ignore[misc]
    return edges


def main(options: Processes) -> None:
    """Measure, print, write."""
    console = Console()
    found: dict[tuple[str, str, int], dict[str, list[float]]] = {}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        with console.status("starting"):
            edges = start(options, Path(folder), stack)
        with Progress(console=console) as progress:
            task = progress.add_task("measuring", total=(options.rounds + 1) * len(edges) * len(TRAFFIC))
            for turn in range(options.rounds + 1):
                for traffic in TRAFFIC:
                    for edge in edges if turn % 2 else reversed(edges):
                        figures = measured(edge, traffic, options)
                        cell = found.setdefault((edge.store, traffic, edge.processes), {q: [] for q in QUANTITIES})
                        # The first round warms up.
                        for quantity, value in figures.items() if turn else ():
                            cell[quantity].append(value)
                        progress.advance(task)
    rows = compared(found, options)
    result = {"command": sys.argv, "goal": GOAL, "rows": rows}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    tell(console, rows, options)


def compared(found: dict[tuple[str, str, int], dict[str, list[float]]], options: Processes) -> list[dict[str, Any]]:
    """A row for each store and kind of connections: both edges' medians, and the ratios of decisions a second."""
    rows = []
    for store in options.stores:
        for traffic in TRAFFIC:
            row: dict[str, Any] = {"store": store, "connections": traffic}
            for processes in (1, options.processes):
                cell = found[store, traffic, processes]
                row[str(processes)] = {q: round(float(np.median(cell[q])), 3) for q in QUANTITIES}
            one, more = found[store, traffic, 1], found[store, traffic, options.processes]
            row["ratio"] = [round(value, 3) for value in ratio_of_medians(more["rate"], one["rate"])]
            # Of the edge's own processor time: what it would be without the load generator beside it.
            edge = [[d + w for d, w in zip(cell["deciding"], cell["writing"], strict=True)] for cell in (more, one)]
            row["cost_ratio"] = [round(value, 3) for value in ratio_of_medians(*edge)]
            rows.append(row)
    return rows


def tell(console: Console, rows: Sequence[dict[str, Any]], options: Processes) -> None:
    """Print the medians and the ratios."""
    table = Table("store", "connections", "processes", "decisions/s", "p50 ms", "p99 ms", *(f"{p} ms" for p in PARTS))
    for row in rows:
        for processes in (1, options.processes):
            cells = row[str(processes)]
            table.add_row(row["store"], row["connections"], str(processes), *(f"{cells[q]:.2f}" for q in QUANTITIES))
    console.print(table)
    for row in rows:
        console.print(
            f"{row['store']}, {row['connections']}: {options.processes} processes decide {shown(row['ratio'])} times "
            f"as often (goal {GOAL:g}), with {shown(row['cost_ratio'])} times the processor time a decision"
        )
    console.print(f"Wrote {options.out}")


if __name__ == "__main__":
    main(tyro.cli(Processes, description=__doc__))
