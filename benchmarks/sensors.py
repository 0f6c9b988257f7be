"""The growth of the edge's own share of a decision, its memory and its requests with the number of sensors J.

    python benchmarks/sensors.py

It flies missions of 10 to 2,000 sensors in turn against real edges with a store: one of mode ``value``, which has no
LLM, and one of mode ``llm`` whose LLM (``instant_llm.py``) answers at once. The share is the edge's own time,
``latency_ms``, less the LLM's. The round trip, also less the LLM's time, includes HTTP and parsing. Decisions of the
LLM-free policy, for example without a heard sensor, are counted and omitted. Every request has the last decision's
outcome. Its learning may run beside the next decision, but earlier learning is finished, because a UAV asks once in
ten seconds.

Then it measures requests: the bytes of one request on each uplink (``full``, ``delta``, ``pruned``), as the clients
send it, plain, gzip and zstd, and the edge's time to unpack, parse and complete it. This time is the round trip of a
request that the edge refuses afterwards, because its outcome is of an unknown decision. For ``pruned`` it also measures
the bytes of the attention weights and the scoring on board. It prints tables and writes JSON.
"""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import httpx
import numpy as np
import psutil
import tyro
import zstandard
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from shared.client.edge_client import EdgeClient
from shared.client.pruned_reports import PrunedReports
from shared.client.report_encoders import DeltaReports
from shared.wire.missions import MissionAttention
from shared.wire.schemas import DecideRequest, MissionSpec, Mode, Outcome, Uplink
from shared.world.scenario import Scenario
from simulator.flying.flight import fly
from simulator.flying.local_edge import HOST, edge_process, usable_port
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.sites.site import Site
from simulator.world.observation import Observation

GOALS = {"share_1000_to_10": 2.0, "share_2000_to_10": 4.0, "memory_mb": 200.0}
UAVS = 3
# The longest time for learning from one outcome.
NO_LESSON_S = 5.0
MODES: tuple[Mode, ...] = ("value", "llm")
ENCODINGS: dict[str, Callable[[bytes], bytes]] = {
    "plain": lambda body: body,
    "gzip": lambda body: gzip.compress(body, 6, mtime=0),
    "zstd": lambda body: zstandard.compress(body, 3),
}


@dataclass(frozen=True)
class Sensors:
    """Measure the edge's share, memory and wire by the number of sensors."""

    sensors: tuple[int, ...] = (10, 100, 1000, 2000)
    """Numbers of sensors J, ascending."""
    steps: int = 6
    """Steps of a mission, at least 2; three UAVs decide at each."""
    rounds: int = 3
    """Missions of each J and mode, in turn."""
    out: Path = Path("runs/sensors.json")
    """Where to write."""


@dataclass
class Edge:
    """A process, and the times of its decisions: by J, one dict of milliseconds for each decision."""

    mode: Mode
    url: str
    process: psutil.Process
    took: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    left_out: int = 0

    def peak_mb(self) -> float:
        """The peak of the process's resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return float(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 1e3


class Pilot(EdgePilot):
    """Asks after every earlier learning step has ended, and stores the requests."""

    def __init__(self, client: EdgeClient, edge: Edge, scenario: Scenario, mission_id: str) -> None:
        super().__init__(client, mission_id, scenario, 0, mode=edge.mode)
        self._status = f"{edge.url}/missions/{mission_id}"
        self._untaught = 0
        self.requests: list[DecideRequest] = []
        self.on_request = self.requests.append

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The edge's choice."""
        known, since = -1, time.monotonic()
        while (told := httpx.get(self._status, timeout=60).json())["feedback"] - self._untaught > told[
            "learner_updates"
        ]:
            if told["learner_updates"] != known:
                known, since = told["learner_updates"], time.monotonic()
            elif time.monotonic() > since + NO_LESSON_S:
                # The modules learn nothing from a decision without their part.
                self._untaught = told["feedback"] - known
            time.sleep(0.005)
        return super().decide(uav, observation, taken)


@contextmanager
def instant_llm() -> Iterator[str]:
    """Run an LLM that answers at once as a process; yields its base URL."""
    port = usable_port(0)
    script = Path(__file__).with_name("instant_llm.py")
    with subprocess.Popen([sys.executable, str(script), "--port", str(port)]) as process:
        try:
            yield f"http://{HOST}:{port}/v1"
        finally:
            process.terminate()


@contextmanager
def edge_of(mode: Mode, folder: Path, llm: str) -> Iterator[Edge]:
    """A real edge with a store."""
    port = usable_port(0)
    url = f"http://{HOST}:{port}"
    settings = {"AICVDS_MODE": mode, "AICVDS_STORE": str(folder / f"{mode}.db"), "AICVDS_LOG_LEVEL": "error"}
    settings |= {"AICVDS_LLM_URL": llm} if mode == "llm" else {}
    with edge_process(port, folder / f"{mode}.log", {**os.environ, **settings}) as process:
        with EdgeClient(url, timeout_s=60) as client:
            client.wait_ready(120)
        yield Edge(mode, url, psutil.Process(process.pid))


def flown(edge: Edge, sensors: int, steps: int, name: str) -> list[DecideRequest]:
    """Fly one mission, note the times of its decisions, and delete it; returns its requests."""
    scenario = Scenario(sensors=sensors, steps=steps)
    with EdgeClient(edge.url, timeout_s=60) as client:
        pilot = Pilot(client, edge, scenario, name)
        client.put_mission(name, pilot.spec)
        flight = fly(Site(scenario), pilot, seed=0)
    for decision in flight.decisions:
        if decision.source != edge.mode or decision.latency_ms is None or decision.rtt_ms is None:
            edge.left_out += 1
            continue
        llm = decision.latency_ms.get("llm", 0.0)
        own = {"share": decision.latency_ms["total"] - llm, "round_trip": decision.rtt_ms - llm}
        edge.took.setdefault(sensors, []).append({**decision.latency_ms, **own})
    httpx.delete(f"{edge.url}/missions/{name}", timeout=60).raise_for_status()
    return pilot.requests


def wire(edge: Edge, now: DecideRequest, before: DecideRequest, repeats: int) -> dict[str, Any]:
    """Bytes and milliseconds of one request on each uplink, after an earlier one, by encoding."""
    name = f"wire-{len(now.sensors.id)}"
    unknown = Outcome(decision_id="0" * 32, cost=0.0)
    before = before.model_copy(update={"mission_id": name, "outcome": None})
    now = now.model_copy(update={"mission_id": name, "outcome": unknown})
    delta, pruned = DeltaReports(), PrunedReports()
    with EdgeClient(edge.url, timeout_s=60) as client, httpx.Client(base_url=edge.url, timeout=60) as http:
        scenario = Scenario(sensors=len(now.sensors.id), steps=now.step + 1)
        pruned.store(now.uav_id, now.step, client.put_mission(name, MissionSpec(scenario=scenario)), None)
        weights = http.get(f"/missions/{name}/attention", headers={"Accept-Encoding": "identity"}).content
        pruned.store(now.uav_id, now.step, MissionAttention.model_validate_json(weights), None)
        first = delta.encode(name, before.step, before)
        answer = client.decide(pruned.encode(name, before.step, first)).response
        for reports in (delta, pruned):
            reports.record_answer(before, answer)
        began = time.perf_counter()
        sent = {"full": now, "pruned": pruned.encode(name, now.step, now)}
        onboard_ms = (time.perf_counter() - began) * 1e3
        sent["delta"] = delta.encode(name, now.step, now)
        found: dict[str, Any] = {rows: {"sensors": len(sent[rows].sensors.id)} for rows in get_args(Uplink)}
        bodies = {rows: sent[rows].model_dump_json(exclude_defaults=rows != "full").encode() for rows in found}
        took: dict[tuple[str, str], list[float]] = {(rows, e): [] for rows in bodies for e in ENCODINGS}
        for _ in range(repeats):
            for rows, encoding in took:
                headers = {"Content-Type": "application/json"}
                headers |= {} if encoding == "plain" else {"Content-Encoding": encoding}
                content = ENCODINGS[encoding](bodies[rows])
                began = time.perf_counter()
                told = http.post("/decide", content=content, headers=headers)
                took[rows, encoding].append((time.perf_counter() - began) * 1e3)
                assert told.status_code == 404 and "outcome.decision_id" in told.text, told.text
        http.delete(f"/missions/{name}").raise_for_status()
    for (rows, encoding), times in took.items():
        found[rows][encoding] = {
            "bytes": len(ENCODINGS[encoding](bodies[rows])),
            "read_ms": round(float(np.median(times)), 2),
        }
    found["pruned"]["onboard_ms"] = round(onboard_ms, 2)
    found["pruned"]["weights_bytes"] = {e: len(encode(weights)) for e, encode in ENCODINGS.items()}
    return found


def main(args: Sensors) -> int:
    """Measure, print, write."""
    console = Console()
    peaks: dict[int, float] = {}
    found_wire: dict[int, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack, Progress(console=console) as progress:
        llm = stack.enter_context(instant_llm())
        edges = [stack.enter_context(edge_of(mode, Path(folder), llm)) for mode in MODES]
        flying = progress.add_task("flying", total=args.rounds * len(args.sensors) * len(edges))
        for edge in edges:
            flown(edge, args.sensors[0], args.steps, "warm-up")
            edge.took.clear()
            edge.left_out = 0
        for number in range(args.rounds):
            for sensors in args.sensors:
                for edge in edges:
                    requests = flown(edge, sensors, args.steps, f"{sensors}-{number}")
                    progress.advance(flying)
                    if edge.mode == "value" and number == 0:
                        peaks[sensors] = edge.peak_mb()
                        found_wire[sensors] = wire(edge, requests[-1], requests[-1 - UAVS], repeats=20)
        took = {edge.mode: {str(sensors): _summary(edge.took[sensors]) for sensors in args.sensors} for edge in edges}
    first = peaks[args.sensors[0]]
    found = {
        "command": sys.argv,
        "decisions_each": UAVS * args.steps * args.rounds,
        "left_out": {edge.mode: edge.left_out for edge in edges},
        "took_ms": took,
        "share_ratio": {mode: _ratios(took[mode], "share") for mode in took},
        "round_trip_ratio": {mode: _ratios(took[mode], "round_trip") for mode in took},
        "peak_memory_growth_mb": {str(sensors): round(peak - first, 1) for sensors, peak in peaks.items()},
        "wire": {str(sensors): told for sensors, told in found_wire.items()},
        "goals": GOALS,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    _tell(console, found, args)
    return 0


def _summary(took: list[dict[str, float]]) -> dict[str, Any]:
    stages = sorted({stage for one in took for stage in one})
    medians = {s: round(float(np.median([one.get(s, 0.0) for one in took])), 3) for s in stages}
    return {"p50": medians, "share_p95": round(float(np.percentile([one["share"] for one in took], 95)), 3)}


def _ratios(by_sensors: dict[str, Any], what: str) -> dict[str, float]:
    p50 = {sensors: told["p50"][what] for sensors, told in by_sensors.items()}
    first = next(iter(p50.values()))
    return {sensors: round(value / first, 2) for sensors, value in p50.items()}


def _tell(console: Console, found: dict[str, Any], args: Sensors) -> None:
    stages = Table("J", "mode", "share p50 ms", "ratio", "p95", "round trip", "ratio", "most of it", "memory MB")
    for sensors in map(str, args.sensors):
        for mode in found["took_ms"]:
            p50 = found["took_ms"][mode][sensors]["p50"]
            own = {s: v for s, v in p50.items() if s not in ("total", "share", "round_trip", "llm")}
            most = sorted(own, key=lambda s: -own[s])[:3]
            stages.add_row(
                f"{int(sensors):,}",
                mode,
                f"{p50['share']:.2f}",
                f"{found['share_ratio'][mode][sensors]:.1f}",
                f"{found['took_ms'][mode][sensors]['share_p95']:.2f}",
                f"{p50['round_trip']:.2f}",
                f"{found['round_trip_ratio'][mode][sensors]:.1f}",
                ", ".join(f"{s} {own[s]:.1f}" for s in most),
                f"+{found['peak_memory_growth_mb'][sensors]:.0f}" if mode == "value" else "",
            )
    console.print(stages)
    encodings = Table("J", "rows", *(f"{encoding} {what}" for encoding in ENCODINGS for what in ("bytes", "ms")))
    for sensors, payloads in found["wire"].items():
        for name, told in payloads.items():
            cells = [
                f"{told[e][what]:,.{places}f}" for e in ENCODINGS for what, places in (("bytes", 0), ("read_ms", 2))
            ]
            encodings.add_row(f"{int(sensors):,}", f"{name} {told['sensors']:,}", *cells)
    console.print(encodings)
    for sensors, payloads in found["wire"].items():
        extra = payloads["pruned"]
        weights = ", ".join(f"{size:,} {encoding}" for encoding, size in extra["weights_bytes"].items())
        console.print(f"pruned, J = {int(sensors):,}: {extra['onboard_ms']:.1f} ms on board; weights {weights} bytes")
    console.print(f"goals: share at 1,000 to 10 at most {GOALS['share_1000_to_10']:g}, at 2,000 at most", end=" ")
    console.print(f"{GOALS['share_2000_to_10']:g}; memory under {GOALS['memory_mb']:g} MB. Wrote {args.out}")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Sensors, description=__doc__)))
