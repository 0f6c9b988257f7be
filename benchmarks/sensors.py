"""The growth of the edge's own share of a decision, its memory and its requests with the number of sensors J.

    python -m benchmarks.sensors

It flies missions of 10 to 2,000 sensors in turn against real edges with a store: one of mode ``value``, which has no
LLM, and one of mode ``llm`` whose LLM (``instant_llm.py``) answers at once. The share is the edge's own time,
``latency_ms``, less the LLM's. The round trip, also less the LLM's time, includes HTTP and parsing. Decisions of the
LLM-free policy, for example without a heard sensor, are counted and omitted. Every request has the last decision's
outcome. Learning from it may overlap the next decision, but earlier learning is finished, because a UAV asks once in
ten seconds.

Then it measures requests: the bytes of one request on each uplink (``full``, ``delta``, ``pruned``), as the clients
send it, plain, gzip and zstd, and the edge's time to unpack, parse and complete it. This time is the round trip of a
request that the edge refuses afterwards, because its outcome is of an unknown decision. For ``pruned`` it also measures
the bytes of the attention weights and the scoring on board. It prints tables and writes JSON.
"""

from __future__ import annotations

import gzip
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import httpx
import numpy as np
import zstandard

from benchmarks.harness import Cell, Goal, Options, Report, Server, edge, in_turn, instant_llm, run
from shared.client.edge_client import EdgeClient
from shared.client.pruned_reports import PrunedReports
from shared.client.report_encoders import DeltaReports
from shared.wire.missions import MissionAttention
from shared.wire.schemas import DecideRequest, MissionSpec, Mode, Outcome, Uplink
from shared.world.scenario import Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.sites.site import Site
from simulator.world.observation import Observation

# The highest ratio of the share to that with the fewest sensors, by number of sensors; the most memory.
GOALS, GOAL_MB = {1000: 2.0, 2000: 4.0}, 200.0
UAVS = 3
# The longest time for learning from one outcome.
NO_LEARNING_S = 5.0
ENCODINGS: dict[str, Callable[[bytes], bytes]] = {
    "plain": lambda body: body,
    "gzip": lambda body: gzip.compress(body, 6, mtime=0),
    "zstd": lambda body: zstandard.compress(body, 3),
}


@dataclass(frozen=True)
class Sensors(Options):
    """Measure the edge's share, memory and wire by the number of sensors."""

    sensors: tuple[int, ...] = (10, 100, 1000, 2000)
    """Numbers of sensors J, ascending."""
    steps: int = 6
    """Steps of a mission, at least 2; three UAVs decide at each."""
    rounds: int = 3
    """Missions of each J and mode, in turn."""


@dataclass
class Timed:
    """An edge, and the times of its decisions: by J, one dict of milliseconds for each decision."""

    mode: Mode
    server: Server
    times_ms: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    left_out: int = 0

    @property
    def url(self) -> str:
        """The URL of the edge."""
        return self.server.url

    def peak_mb(self) -> float:
        """The peak of the process's resident memory."""
        status = Path(f"/proc/{self.server.process.pid}/status").read_text()
        return float(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 1e3


class Pilot(EdgePilot):
    """Requests each decision after every earlier learning step has ended, and stores the requests."""

    def __init__(self, client: EdgeClient, edge: Timed, scenario: Scenario, mission_id: str) -> None:
        super().__init__(client, mission_id, scenario, 0, mode=edge.mode)
        self._status = f"{edge.url}/missions/{mission_id}"
        self._skipped = 0
        self.requests: list[DecideRequest] = []
        self.on_request = self.requests.append

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The edge's choice."""
        known, since = -1, time.monotonic()
        while True:
            status = httpx.get(self._status, timeout=60).json()
            if status["feedback"] - self._skipped <= status["learner_updates"]:
                break
            if status["learner_updates"] != known:
                known, since = status["learner_updates"], time.monotonic()
            elif time.monotonic() > since + NO_LEARNING_S:
                # The modules do not learn from a decision in which they took no part.
                self._skipped = status["feedback"] - known
            time.sleep(0.005)
        return super().decide(uav, observation, taken)


def flown(edge: Timed, sensors: int, steps: int, name: str) -> list[DecideRequest]:
    """Fly one mission, record the times of its decisions, and delete it; returns its requests."""
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
        edge.times_ms.setdefault(sensors, []).append({**decision.latency_ms, **own})
    httpx.delete(f"{edge.url}/missions/{name}", timeout=60).raise_for_status()
    return pilot.requests


def wire(url: str, now: DecideRequest, before: DecideRequest, repeats: int) -> dict[str, Any]:
    """Bytes and milliseconds of one request on each uplink, after an earlier one, by encoding."""
    name = f"wire-{len(now.sensors.id)}"
    unknown = Outcome(decision_id="0" * 32, cost=0.0)
    before = before.model_copy(update={"mission_id": name, "outcome": None})
    now = now.model_copy(update={"mission_id": name, "outcome": unknown})
    delta, pruned = DeltaReports(), PrunedReports()
    with EdgeClient(url, timeout_s=60) as client, httpx.Client(base_url=url, timeout=60) as http:
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
                response = http.post("/decide", content=content, headers=headers)
                took[rows, encoding].append((time.perf_counter() - began) * 1e3)
                assert response.status_code == 404 and "outcome.decision_id" in response.text, response.text
        http.delete(f"/missions/{name}").raise_for_status()
    for (rows, encoding), times in took.items():
        found[rows][encoding] = {
            "bytes": len(ENCODINGS[encoding](bodies[rows])),
            "read_ms": round(float(np.median(times)), 2),
        }
    found["pruned"]["onboard_ms"] = round(onboard_ms, 2)
    found["pruned"]["weights_bytes"] = {e: len(encode(weights)) for e, encode in ENCODINGS.items()}
    return found


def measure(args: Sensors) -> Report:
    """Fly missions of every number of sensors on both edges in turn."""
    peaks: dict[int, float] = {}
    wires: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        llm = stack.enter_context(instant_llm())
        backed: dict[Mode, dict[str, str]] = {"value": {}, "llm": {"LLM_URL": f"{llm.url}/v1"}}
        edges = []
        for mode, more in backed.items():
            server = stack.enter_context(edge({"MODE": mode, "LOG_LEVEL": "error", **more}))
            edges.append(Timed(mode, server))
            flown(edges[-1], args.sensors[0], args.steps, "warm-up")
            edges[-1].times_ms, edges[-1].left_out = {}, 0

        def flying(timed: Timed, sensors: int) -> Callable[[int], None]:
            def flight(number: int) -> None:
                requests = flown(timed, sensors, args.steps, f"{sensors}-{number}")
                if timed.mode == "value" and number == 0:
                    peaks[sensors] = timed.peak_mb()
                    wires[str(sensors)] = wire(timed.url, requests[-1], requests[-1 - UAVS], repeats=20)

            return flight

        in_turn({(sensors, e.mode): flying(e, sensors) for sensors in args.sensors for e in edges}, args.rounds)
    took = {e.mode: {str(sensors): _summary(e.times_ms[sensors]) for sensors in args.sensors} for e in edges}
    found: dict[str, Any] = {
        "decisions_each": UAVS * args.steps * args.rounds,
        "left_out": {e.mode: e.left_out for e in edges},
        "took_ms": took,
        "share_ratio": {mode: _ratios(took[mode], "share") for mode in took},
        "round_trip_ratio": {mode: _ratios(took[mode], "round_trip") for mode in took},
        "peak_memory_growth_mb": {str(j): round(peak - peaks[args.sensors[0]], 1) for j, peak in peaks.items()},
        "wire": wires,
    }
    grown = max(found["peak_memory_growth_mb"].values())
    goals = [
        Goal(f"share, mode {mode}, {j} sensors to {args.sensors[0]}", ratios[str(j)], most=most)
        for mode, ratios in found["share_ratio"].items()
        for j, most in GOALS.items()
        if j in args.sensors
    ]
    return Report(found, _tables(found), [*goals, Goal("growth of memory, MB", grown, most=GOAL_MB)])


def _summary(took: list[dict[str, float]]) -> dict[str, Any]:
    stages = sorted({stage for one in took for stage in one})
    medians = {s: round(float(np.median([one.get(s, 0.0) for one in took])), 3) for s in stages}
    return {"p50": medians, "share_p95": round(float(np.percentile([one["share"] for one in took], 95)), 3)}


def _ratios(by_sensors: dict[str, Any], quantity: str) -> dict[str, float]:
    p50 = {sensors: times["p50"][quantity] for sensors, times in by_sensors.items()}
    first = next(iter(p50.values()))
    return {sensors: round(value / first, 2) for sensors, value in p50.items()}


def _tables(found: dict[str, Any]) -> dict[str, dict[str, dict[str, Cell]]]:
    stages, sizes, pruned = {}, {}, {}
    for mode, by_sensors in found["took_ms"].items():
        for sensors, times in by_sensors.items():
            p50 = times["p50"]
            own = {s: v for s, v in p50.items() if s not in ("total", "share", "round_trip", "llm")}
            stages[f"J = {sensors}, {mode}"] = {
                "share p50 ms": p50["share"],
                "ratio": found["share_ratio"][mode][sensors],
                "p95": times["share_p95"],
                "round trip": p50["round_trip"],
                "its ratio": found["round_trip_ratio"][mode][sensors],
                "most of it": ", ".join(f"{s} {own[s]:.1f}" for s in sorted(own, key=lambda s: -own[s])[:3]),
                "memory MB": found["peak_memory_growth_mb"][sensors] if mode == "value" else "",
            }
    for sensors, payloads in found["wire"].items():
        for uplink, payload in payloads.items():
            sizes[f"J = {sensors}, {uplink}, {payload['sensors']} rows"] = {
                f"{e} {label}": payload[e][quantity]
                for e in ENCODINGS
                for quantity, label in (("bytes", "bytes"), ("read_ms", "ms"))
            }
        payload = payloads["pruned"]
        weights = {f"weights, {encoding}": size for encoding, size in payload["weights_bytes"].items()}
        pruned[f"J = {sensors}"] = {"ms on board": payload["onboard_ms"], **weights}
    return {"Share of a decision": stages, "A request": sizes, "Uplink pruned": pruned}


if __name__ == "__main__":
    run(Sensors, measure)
