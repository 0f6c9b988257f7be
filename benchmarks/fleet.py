"""The missions of one edge: decisions a second, p99 and memory for 1 to 1,000 missions, and the cost of learning.

    python -m benchmarks.fleet

It starts a real edge of mode ``value`` with a store. Missions of scenario ``paper`` (3 UAVs, 10 sensors) send
``POST /decide``, each request with its UAV's last outcome, over a few connections that wait for each answer. The memory
of a mission is the growth of the edge's resident memory, divided by the missions. To show whether learning slows
decisions, blocks of decisions with outcomes and without follow each other at a pace that the edge can hold; the result
is the ratio of their p99. Client and edge share the machine's cores. It prints a table and writes JSON.
"""

from __future__ import annotations

import functools
import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.harness import Goal, Options, Report, Server, edge, in_turn, run
from benchmarks.missions import UAVS, Flown, Radio, at_once, paced

GOAL_KB = 200.0


@dataclass(frozen=True)
class Fleet(Options):
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
    rounds: int = 4
    """Blocks with outcomes, and as many without."""


def measure(args: Fleet) -> Report:
    """Fly on one edge."""
    settings = {"MODE": "value", "LOG_LEVEL": "error", "MAX_MISSIONS": max(args.missions) + 1}
    with edge(settings) as server:
        found = _figures(args, server)
    memory, learning = found["memory"], found["learning"]
    paced_rows = {"with outcomes": learning["with_outcomes"], "without": learning["without"]}
    ratio = {name: learning[f"{name}_ratio"] for name in ("p50_ms", "p99_ms")}
    tables = {
        f"Missions, {args.connections} connections": {f"{int(n):,}": rate for n, rate in found["rates"].items()},
        f"{args.pace:g} decisions a second": {**paced_rows, "ratio": ratio},
        "Memory of a mission": {
            f"of {args.each} decisions": {"kB": memory["kb_a_mission"]},
            f"of {args.lifetime}": {"kB": memory["kb_a_veteran"]},
        },
    }
    return Report(found, tables, [Goal("kB of a mission", memory["kb_a_veteran"], most=GOAL_KB)])


def _figures(args: Fleet, edge: Server) -> dict[str, Any]:
    radios = [Radio(edge, seed) for seed in range(args.connections)]
    warm = radios[0].create("warm-up")
    at_once(radios[:1], [lambda radio: radio.decide(warm, True)] * 60)
    rates, missions = dict[str, dict[str, float]](), list[Flown]()
    empty = edge.resident_bytes()
    for number in track(args.missions, "flying"):
        missions += [radios[0].create(f"fleet-{n}") for n in range(len(missions), number)]
        rates[str(number)] = _rates(radios, missions, max(args.decisions, UAVS * number))
    learning = _learning(args, radios, missions[: args.missions[-2] if len(args.missions) > 1 else 1])
    memory = {"missions": float(len(missions)), "decisions_each": float(args.each)}
    _fill(radios, missions, args.each)
    memory["kb_a_mission"] = (edge.resident_bytes() - empty) / len(missions) / 1e3
    before, veterans = edge.resident_bytes(), missions[-args.veterans :]
    _fill(radios, veterans, args.lifetime)
    memory |= {"veterans": float(len(veterans)), "lifetime": float(args.lifetime)}
    memory["kb_a_veteran"] = memory["kb_a_mission"] + (edge.resident_bytes() - before) / len(veterans) / 1e3
    return {"rates": rates, "learning": learning, "memory": {k: round(v, 1) for k, v in memory.items()}}


def _rates(radios: Sequence[Radio], missions: Sequence[Flown], count: int) -> dict[str, float]:
    turns = [missions[index % len(missions)] for index in range(count)]
    began = time.perf_counter()
    took = at_once(radios, [lambda radio, mission=mission: radio.decide(mission, True) for mission in turns])  # type: ignore[misc]
    return {"decisions_a_s": round(count / (time.perf_counter() - began), 1), **_percentiles(took)}


def _learning(args: Fleet, radios: Sequence[Radio], missions: Sequence[Flown]) -> dict[str, Any]:
    def block(learn: bool) -> Callable[[int], list[float]]:
        return lambda _: paced(radios, missions, args.block, args.pace, learn)

    took = in_turn({"with_outcomes": block(True), "without": block(False)}, args.rounds)
    times = {name: _percentiles(functools.reduce(operator.iadd, blocks, [])) for name, blocks in took.items()}
    ratios = {f"{p}_ratio": round(times["with_outcomes"][p] / times["without"][p], 2) for p in ("p50_ms", "p99_ms")}
    return {"pace": args.pace, "missions": len(missions), **times, **ratios}


def _fill(radios: Sequence[Radio], missions: Sequence[Flown], decisions: int) -> None:
    def fill(mission: Flown) -> Callable[[Radio], None]:
        def step(radio: Radio) -> None:
            while mission.decisions < decisions:
                if mission.uav:
                    radio.decide(mission, True)
                else:
                    radio.step(mission)

        return step

    at_once(radios, [fill(mission) for mission in missions])


def _percentiles(took: Sequence[float]) -> dict[str, float]:
    return {f"p{p}_ms": round(float(np.percentile(took, p)), 2) for p in (50, 95, 99)}


if __name__ == "__main__":
    run(Fleet, measure)
