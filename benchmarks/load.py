"""A load of UAVs on one service: each sends its next request after each answer. Measures latency and rate."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.harness import Server
from simulator.flying.local_edge import HOST

FLEET, SENSORS = 3, 10
# Settings of an edge of mode ``llm`` with an LLM server that answers at once.
EDGE = {
    "MODE": "llm",
    "PLANNER": "off",
    # The verifier would sometimes reject the LLM server's answer, and the benchmark would measure the policy's.
    "VERIFY": "off",
    # With a short deadline a busy machine would answer without the LLM, and its slowness would not show.
    "DEADLINE_MS": "20000",
}


@dataclass
class Uav:
    """One UAV: it reports, gets a decision, and reports again with the decision's outcome."""

    number: int
    answer: dict[str, Any] = field(default_factory=dict)
    step: int = 0

    @property
    def mission(self) -> str:
        """The mission of the UAV's fleet."""
        return f"fleet{self.number // FLEET}"

    def report(self, outcomes: bool) -> bytes:
        """The body of the next request."""
        random = np.random.default_rng([self.number, self.step])
        queues = [float(q) for q in random.integers(0, 60, SENSORS)]
        gains = [round(float(g), 1) for g in random.uniform(-110, -80, SENSORS)]
        body: dict[str, Any] = {
            "mission_id": self.mission,
            "step": self.step,
            "uav_id": self.number % FLEET,
            "position": [500.0, 450.0],
            "sensors": sensor_columns(self.step, queues, gains),
        }
        if outcomes and self.answer:
            body["outcome"] = {"decision_id": self.answer["decision_id"], "cost": 0.2, "failed": False}
        self.step += 1
        return json.dumps(body).encode()


@dataclass(frozen=True)
class Target:
    """A service under load: its key, and the requests of a UAV."""

    name: str
    server: Server
    body: Callable[[Uav], bytes]
    key: str | None = None
    path: str = "/decide"

    def request(self, uav: Uav) -> bytes:
        """The UAV's next request, with its headers."""
        body = self.body(uav)
        key = f"Authorization: Bearer {self.key}\r\n" if self.key else ""
        head = f"POST {self.path} HTTP/1.1\r\nHost: {HOST}\r\nContent-Type: application/json\r\n{key}"
        return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def sensor_columns(step: int, queues: list[Any], gains: list[float] | None = None) -> dict[str, list[Any]]:
    """The sensors of a report, all heard in this step; by default every gain is -90 dB."""
    ids = range(len(queues))
    return {
        "id": list(ids),
        "x": [100.0 * n for n in ids],
        "y": [90.0 * n for n in ids],
        "queue": queues,
        "battery": [40.0 for _ in ids],
        "channel_gain": gains or [-90.0 for _ in ids],
        "last_seen": [step for _ in ids],
    }


def made_key(keys: Path) -> str:
    """Add a key to the file, with a rate limit that no load reaches; returns the key."""
    add = ["keys", "add", "load", "--file", str(keys), "--scopes", "decide", "admin", "--per-minute", "1000000"]
    command = [sys.executable, "-m", "shared.kit.command_line", *add]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1]


def make_missions(edge: Target, uavs: Iterable[Uav]) -> None:
    """Create the UAVs' missions on an edge."""
    for mission in {uav.mission for uav in uavs}:
        url, bearer = f"{edge.server.url}/missions/{mission}", {"Authorization": f"Bearer {edge.key}"}
        httpx.put(url, json={}, headers=bearer, timeout=60).raise_for_status()


def load(target: Target, uavs: list[Uav], seconds: float) -> dict[str, float]:
    """p50 and p99 in ms, answers a second, and processor time an answer in ms, of concurrent UAVs."""

    async def run_all() -> tuple[list[float], float]:
        took_ms: list[float] = []
        began = time.perf_counter()
        await asyncio.gather(*(_fly(target, uav, began + seconds, took_ms) for uav in uavs))
        return took_ms, time.perf_counter() - began

    busy_s = target.server.processor_s()
    took_ms, lasted = asyncio.run(run_all())
    busy_s = target.server.processor_s() - busy_s
    p50, p99 = np.percentile(took_ms, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "rps": len(took_ms) / lasted, "cpu": busy_s * 1e3 / len(took_ms)}


async def _fly(target: Target, uav: Uav, ends: float, took_ms: list[float]) -> None:
    reader, writer = await asyncio.open_connection(HOST, target.server.port)
    try:
        while time.perf_counter() < ends:
            request = target.request(uav)
            began = time.perf_counter()
            writer.write(request)
            head = await reader.readuntil(b"\r\n\r\n")
            length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
            content = await reader.readexactly(length)
            took_ms.append((time.perf_counter() - began) * 1e3)
            if not head.startswith(b"HTTP/1.1 200"):
                raise SystemExit(f"{target.name}: {content[:500].decode()}")
            uav.answer = json.loads(content)
            # If the LLM assigns one sensor to two concurrent UAVs, the edge assigns another one to the second.
            if uav.answer.get("reason") not in (None, "answer_reserved"):
                raise SystemExit(f"{target.name}: no answer of the LLM: {uav.answer['reason']}")
    finally:
        writer.close()
