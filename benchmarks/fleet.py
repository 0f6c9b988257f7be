"""The missions of one edge: decisions a second, p99 and memory for 1 to 1,000 missions, and the cost of learning.

    python benchmarks/fleet.py

It starts a real edge of mode ``value`` with a store. Missions of scenario ``paper`` (3 UAVs, 10 sensors) send
``POST /decide``, each request with its UAV's last outcome, over a few connections that wait for each answer. The memory
of a mission is the growth of the edge's resident memory, divided by the missions. To show whether learning slows
decisions, blocks of decisions with outcomes and without follow each other at a pace that the edge can hold; the result
is the ratio of their p99. Client and edge share the machine's cores. It prints a table and writes JSON.
"""

from __future__ import annotations

import http.client
import json
import os
import random
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from shared.client.edge_client import EdgeClient
from simulator.flying.local_edge import HOST, edge_process, usable_port

UAVS, SENSORS = 3, 10
GOAL_KB = 200.0


@dataclass(frozen=True)
class Fleet:
    """Fly 1 to 1,000 missions on one edge."""

    missions: tuple[int, ...] = (1, 10, 100, 1000)
    """Numbers of missions, ascending."""
    decisions: int = 1200
    """Measured decisions at each number; each UAV of each mission gets at least one."""
    connections: int = 4
    """Concurrent connections."""
    each: int = 12
    """Decisions of each mission at the largest number, for the memory of a mission."""
    veterans: int = 100
    """Missions that fly on, for the memory of a long mission."""
    lifetime: int = 100
    """Decisions of a long mission."""
    pace: float = 30.0
    """Decisions a second, for p99 with outcomes and without."""
    block: int = 150
    """Decisions in a block at that pace."""
    blocks: int = 4
    """Blocks with outcomes, and as many without."""
    out: Path = Path("runs/fleet.json")
    """Where to write."""


@dataclass
class Flown:
    """A mission's progress in its flight: its next decision, and each UAV's unreported outcome."""

    name: str
    told: int = 0
    owed: dict[int, dict[str, Any]] = field(default_factory=dict)
    turn: threading.Lock = field(default_factory=threading.Lock)

    @property
    def uav(self) -> int:
        """The UAV of the next decision."""
        return self.told % UAVS

    @property
    def step(self) -> int:
        """The step of the next decision."""
        return self.told // UAVS


class Radio:
    """One connection to the edge."""

    def __init__(self, port: int, seed: int) -> None:
        self._http = http.client.HTTPConnection(HOST, port, timeout=60)
        self._random = random.Random(seed)

    def decide(self, mission: Flown, learn: bool) -> float:
        """Ask for the mission's next decision; returns the milliseconds from the request to the answer."""
        with mission.turn:
            uav = mission.uav
            outcome = mission.owed.pop(uav, None) if learn else None
            body = {**self._state(mission, uav), "mission_id": mission.name, "step": mission.step, "outcome": outcome}
            answer, took_ms = self.post("/decide", body)
            self._told(mission, answer)
        return took_ms

    def step(self, mission: Flown) -> None:
        """Ask for the mission's next three decisions in one batch."""
        states = [{**self._state(mission, uav), "outcome": mission.owed.pop(uav, None)} for uav in range(UAVS)]
        answer, _ = self.post("/decide/batch", {"mission_id": mission.name, "step": mission.step, "uavs": states})
        for one in answer["decisions"]:
            self._told(mission, one)

    def post(self, path: str, body: dict[str, Any], method: str = "POST") -> tuple[dict[str, Any], float]:
        """The answer and its milliseconds."""
        content = json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        # The UAVs of `aicvds simulate` do the same.
        headers |= {"Idempotency-Key": uuid.uuid4().hex} if path.startswith("/decide") else {}
        try:
            response, data, took_ms = self._ask(method, path, content, headers)
        except (ConnectionError, http.client.RemoteDisconnected):
            # The edge closes idle connections after seconds; the key makes the second attempt the same request.
            self._http.close()
            response, data, took_ms = self._ask(method, path, content, headers)
        if response.status >= 300:
            raise SystemExit(f"fleet: {path} answered {response.status}: {data[:300]!r}")
        return (json.loads(data) if data else {}), took_ms

    def _ask(
        self, method: str, path: str, content: bytes, headers: dict[str, str]
    ) -> tuple[http.client.HTTPResponse, bytes, float]:
        began = time.perf_counter()
        self._http.request(method, path, content, headers)
        response = self._http.getresponse()
        data = response.read()
        return response, data, (time.perf_counter() - began) * 1e3

    def _state(self, mission: Flown, uav: int) -> dict[str, Any]:
        sensors = {
            "id": list(range(SENSORS)),
            "x": [100.0 * i for i in range(SENSORS)],
            "y": [90.0 * i for i in range(SENSORS)],
            "queue": [self._random.randrange(60) for _ in range(SENSORS)],
            "battery": [40.0] * SENSORS,
            "channel_gain": [-90.0] * SENSORS,
            "last_seen": [mission.step] * SENSORS,
        }
        return {"uav_id": uav, "position": [500.0 + 10 * uav, 450.0], "sensors": sensors}

    def _told(self, mission: Flown, answer: dict[str, Any]) -> None:
        cost = self._random.random()
        mission.owed[answer["uav_id"]] = {"decision_id": answer["decision_id"], "cost": cost, "failed": cost > 0.8}
        mission.told += 1


def at_once(radios: Sequence[Radio], work: Sequence[Callable[[Radio], float | None]]) -> list[float]:
    """Do all of the work, each radio one job after the other; returns the results."""
    waiting, found, faults = iter(work), list[float](), list[BaseException]()
    lock = threading.Lock()

    def fly(radio: Radio) -> None:
        try:
            while True:
                with lock:
                    task = next(waiting, None)
                if task is None or faults:
                    return
                if (took := task(radio)) is not None:
                    found.append(took)
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=fly, args=(radio,), daemon=True) for radio in radios]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if faults:
        raise faults[0]
    return found


def paced(radios: Sequence[Radio], missions: Sequence[Flown], count: int, pace: float, learn: bool) -> list[float]:
    """Start decisions at even intervals, without waiting for earlier answers while a radio is free."""
    began = time.perf_counter()

    def at(index: int) -> Callable[[Radio], float]:
        def decide(radio: Radio) -> float:
            time.sleep(max(0.0, began + index / pace - time.perf_counter()))
            return radio.decide(missions[index % len(missions)], learn)

        return decide

    return at_once(radios, [at(index) for index in range(count)])


def main(args: Fleet) -> int:
    """Fly, print, write."""
    console = Console()
    with tempfile.TemporaryDirectory() as folder:
        port = usable_port(0)
        settings = {"AICVDS_MODE": "value", "AICVDS_STORE": f"{folder}/missions.db", "AICVDS_LOG_LEVEL": "error"}
        settings["AICVDS_MAX_MISSIONS"] = str(max(args.missions) + 1)
        with edge_process(port, Path(folder) / "edge.log", {**os.environ, **settings}) as process:
            with EdgeClient(f"http://{HOST}:{port}", timeout_s=60) as client:
                client.wait_ready(120)
            found = _measure(args, port, psutil.Process(process.pid), console)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"command": sys.argv, **found, "goal_kb": GOAL_KB}, indent=1) + "\n")
    _tell(console, found, args)
    return 0


def _resident(edge: psutil.Process) -> int:
    """The edge's resident bytes, with the process that writes its store."""
    return sum(each.memory_info().rss for each in (edge, *edge.children()))


def _measure(args: Fleet, port: int, edge: psutil.Process, console: Console) -> dict[str, Any]:
    radios = [Radio(port, seed) for seed in range(args.connections)]
    warm = _made(radios[0], "warm-up")
    at_once(radios[:1], [lambda radio: radio.decide(warm, True)] * 60)
    rates, missions = dict[str, dict[str, float]](), list[Flown]()
    empty = _resident(edge)
    with Progress(console=console) as progress:
        task = progress.add_task("flying", total=len(args.missions) + 3)
        for number in args.missions:
            missions += [_made(radios[0], f"fleet-{n}") for n in range(len(missions), number)]
            rates[str(number)] = _rates(radios, missions, max(args.decisions, UAVS * number))
            progress.advance(task)
        learning = _learning(args, radios, missions[: args.missions[-2] if len(args.missions) > 1 else 1])
        progress.advance(task)
        memory = {"missions": float(len(missions)), "decisions_each": float(args.each)}
        _fill(radios, missions, args.each)
        memory["kb_a_mission"] = (_resident(edge) - empty) / len(missions) / 1e3
        progress.advance(task)
        before, veterans = _resident(edge), missions[-args.veterans :]
        _fill(radios, veterans, args.lifetime)
        memory |= {"veterans": float(len(veterans)), "lifetime": float(args.lifetime)}
        grown = (_resident(edge) - before) / len(veterans) / 1e3
        memory["kb_a_veteran"] = memory["kb_a_mission"] + grown
        progress.advance(task)
    return {"rates": rates, "learning": learning, "memory": {k: round(v, 1) for k, v in memory.items()}}


def _made(radio: Radio, name: str) -> Flown:
    radio.post(f"/missions/{name}", {"mode": "value"}, "PUT")
    return Flown(name)


def _rates(radios: Sequence[Radio], missions: Sequence[Flown], count: int) -> dict[str, float]:
    turns = [missions[index % len(missions)] for index in range(count)]
    began = time.perf_counter()
    took = at_once(radios, [lambda radio, mission=mission: radio.decide(mission, True) for mission in turns])  # type: ignore[misc]
    return {"decisions_a_s": round(count / (time.perf_counter() - began), 1), **_percentiles(took)}


def _learning(args: Fleet, radios: Sequence[Radio], missions: Sequence[Flown]) -> dict[str, Any]:
    took: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(args.blocks):
        for learn in took:
            took[learn] += paced(radios, missions, args.block, args.pace, learn)
    told = {"with_outcomes": _percentiles(took[True]), "without": _percentiles(took[False])}
    ratios = {f"{p}_ratio": round(told["with_outcomes"][p] / told["without"][p], 2) for p in ("p50_ms", "p99_ms")}
    return {"pace": args.pace, "missions": len(missions), **told, **ratios}


def _fill(radios: Sequence[Radio], missions: Sequence[Flown], decisions: int) -> None:
    def fill(mission: Flown) -> Callable[[Radio], None]:
        def step(radio: Radio) -> None:
            while mission.told < decisions:
                if mission.uav:
                    radio.decide(mission, True)
                else:
                    radio.step(mission)

        return step

    at_once(radios, [fill(mission) for mission in missions])


def _percentiles(took: Sequence[float]) -> dict[str, float]:
    return {f"p{p}_ms": round(float(np.percentile(took, p)), 2) for p in (50, 95, 99)}


def _tell(console: Console, found: dict[str, Any], args: Fleet) -> None:
    table = Table("missions", "decisions/s", "p50 ms", "p95 ms", "p99 ms", title=f"{args.connections} connections")
    for number, told in found["rates"].items():
        table.add_row(f"{int(number):,}", *(f"{value:.1f}" for value in told.values()))
    console.print(table)
    table = Table("", "p50 ms", "p95 ms", "p99 ms", title=f"{args.pace:g} decisions a second")
    for name in ("with_outcomes", "without"):
        table.add_row(name.replace("_", " "), *(f"{value:.1f}" for value in found["learning"][name].values()))
    console.print(table, f"p99 with outcomes to without: {found['learning']['p99_ms_ratio']:.2f}")
    memory = found["memory"]
    console.print(
        f"memory a mission: {memory['kb_a_mission']:.0f} kB over {memory['missions']:.0f} missions of {args.each} "
        f"decisions, {memory['kb_a_veteran']:.0f} kB after {args.lifetime} (goal under {GOAL_KB:g}). Wrote {args.out}"
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Fleet, description=__doc__)))
