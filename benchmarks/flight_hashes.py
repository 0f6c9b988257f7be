"""One SHA-256 for each flight, to prove that a change of the code changes no decision and no loss.

    python -m benchmarks.flight_hashes --seeds 0 1 2 --out runs/before.json
    python -m benchmarks.flight_hashes --seeds 0 1 2 --out runs/after.json --against runs/before.json

It starts `aicvds serve` with no LLM and a store of its own, and flies every scenario in modes `value`, `policy` and
`guided`, `paper` with every uplink, and on board the paper's EOF and WQCS, two heuristics and MPC. A hash covers, in
the order of the flight, each decision's step, UAV, sensor, velocity, source, reason and failure, its cost and its UAV's
lost packets, as `decisions.jsonl` has them.

A flight repeats to the bit if no wall clock decides. The planner's search has one limit of wall clock,
AICVDS_PLANNER_MS, which has its largest value here; the deadline is a minute. Requests come one
after another, so the edge learns from each outcome before the next decision. The radio of `lossy_uplink` draws its
losses from the seed; its jitter only delays requests, and is off here. A flight in which a clock decided nevertheless
is an error. Another version of numba may plan differently. Another processor rounds differently, which seldom
changes a decision.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import tyro

from benchmarks.harness import edge
from shared.client.edge_client import EdgeClient
from simulator.commands.options import site_from_options
from simulator.flying.edge_session import LossyTransport
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, LocalPilot

# The only internal names: the functions that fly a world, and the radio that loses requests.
from simulator.records.flight import Flight
from simulator.sites.site import Site

SCENARIOS = ("paper", "pipeline", "stress", "dense", "lossy_uplink")
MODES = ("value", "policy", "guided")
ON_BOARD = ("eof", "wqcs", "longest_queue", "queue_and_channel", "mpc")
FIELDS = ("step", "uav_id", "sensor_id", "velocity", "source", "reason", "failed", "cost", "lost_packets")
DEADLINE_MS = 60_000
# An answer waits for the store, and so for learning from its request's outcome. Without a store the next request may
# overtake learning on a busy machine.
SETTINGS = {"MODE": "value", "PLANNER_MS": "60000"}
# The reasons of decisions that depend on a clock.
LATE = {"critic_timeout", "llm_timeout", "llm_busy", "edge_refused", "edge_protocol"}


@dataclass(frozen=True)
class Hashes:
    """Fly, hash, and compare."""

    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the worlds."""
    steps: int | None = None
    """Steps of a flight; by default the scenario's."""
    only: str = ""
    """A regular expression: fly only the flights whose names match, such as `^paper (value|eof)`."""
    out: Path = Path("runs/flight_hashes.json")
    """File to write."""
    against: Path | None = None
    """An earlier result: compare the flights that are in both; the exit code is 1 if one differs."""


class Course(NamedTuple):
    """A flight's name: scenario, decider, and for an edge the uplink."""

    scenario: str
    decides: str
    uplink: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in self if part)


def courses() -> list[Course]:
    """All flights, the quick ones first."""
    on_board = [Course(scenario, policy) for policy in ON_BOARD for scenario in SCENARIOS]
    over_edge = [Course(scenario, mode, "full") for mode in MODES for scenario in SCENARIOS]
    reduced = [Course("paper", mode, uplink) for mode in MODES for uplink in ("delta", "pruned")]
    return [*on_board, *over_edge, *reduced]


def main(options: Hashes) -> int:
    """Fly, compare and write; returns the exit code."""
    chosen = [course for course in courses() if re.search(options.only, str(course))]
    before = json.loads(options.against.read_text())["flights"] if options.against else {}
    flights: dict[str, dict[str, Any]] = {}
    differ = []
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with edge(SETTINGS) as server:
        for seed in options.seeds:
            for course in chosen:
                began = time.monotonic()
                flight = flown(course, seed, options.steps, server.url)
                name = f"{course}, {flight.steps_flown} steps, seed {seed}"
                flights[name] = summary_of(flight, name)
                took = time.monotonic() - began
                same = flights[name] == before.get(name, flights[name])
                if not same:
                    differ.append(name)
                verdict = "" if name not in before else " same" if same else " DIFFERS"
                print(f"{flights[name]['sha256'][:16]} {name}: {took:.1f} s{verdict}", flush=True)
                options.out.write_text(json.dumps({"flights": flights}, indent=1) + "\n")
    compared = len(flights.keys() & before.keys())
    if options.against:
        print(f"{len(differ)} of {compared} flights differ", *differ, sep="\n  ")
    return 1 if differ or (options.against and not compared) else 0


def summary_of(flight: Flight, name: str) -> dict[str, Any]:
    """A flight's hash, and sums that help to find a difference; raises ``RuntimeError`` if a clock decided."""
    lines = [json.loads(decision.model_dump_json()) for decision in flight.decisions]
    if late := {line["reason"] for line in lines} & LATE:
        raise RuntimeError(f"{name}: decided by a clock, so nothing is proven: {', '.join(sorted(late))}")
    rows = [[line[field] for field in FIELDS] for line in lines]
    return {
        "sha256": hashlib.sha256(json.dumps(rows).encode()).hexdigest(),
        "decisions": len(rows),
        "lost_packets": sum(tally.lost_packets for tally in flight.tally),
        "velocities": sum(line["velocity"] for line in lines),
    }


def flown(course: Course, seed: int, steps: int | None, url: str) -> Flight:
    """One flight, on board or over the edge."""
    site = site_from_options(course.scenario, None, steps)
    if not course.uplink:
        return fly(site, LocalPilot(course.decides, site.scenario, seed), seed)
    return _over(url, course, site, seed)


def _over(url: str, course: Course, site: Site, seed: int) -> Flight:
    scenario, mission_id = site.scenario, f"hash-{course.scenario}-{seed}"
    radio = LossyTransport(httpx.HTTPTransport(), drop=scenario.uplink_drop, jitter_ms=0.0, seed=seed)
    timeout_s = DEADLINE_MS / 1e3 + 5.0
    uplink: Any = course.uplink
    mode: Any = course.decides
    with (
        EdgeClient(url, timeout_s=timeout_s) as ground,
        EdgeClient(url, timeout_s=timeout_s, seed=seed, transport=radio, uplink=uplink) as air,
    ):
        pilot = EdgePilot(air, mission_id, scenario, seed, mode=mode, deadline_ms=DEADLINE_MS, probe=ground)
        ground.put_mission(mission_id, pilot.spec)
        flight = fly(site, pilot, seed)
        ground.delete_mission(mission_id)
    if not scenario.uplink_drop and any(decision.source == "onboard" for decision in flight.decisions):
        raise RuntimeError(f"{course}: the edge did not decide: {pilot.last_error}")
    return flight


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Hashes, description=__doc__)))
