"""The latency that the edge adds to an LLM that answers at once, beside a bare forwarder and LiteLLM's proxy.

    python benchmarks/overhead.py

Before an LLM server that answers at once (``instant_llm.py``) there are, each a process of its own on loopback:
(a) ``bare``, a FastAPI application that only passes the same JSON on with httpx; (b) ``litellm``, LiteLLM's proxy with
the same prompt as a chat completion, behind its one key; (c) ``edge``, ``POST /decide`` in mode ``llm`` with everything
on: keys, attention, prompt, token counting, checks, SQLite store, metrics, and outcomes that it learns from;
(d) ``edge, no outcomes``: the same without outcomes; (e) ``edge, no store``: as (c), but in memory only. 3 and 64 UAVs
send their next request after each answer. Every round measures all of (a) to (e), so that a noisy machine is noisy for
all. Added latency is the latency at the UAV less that of the LLM server with the same load generator. It prints
medians over rounds and their ratios with 95% bootstrap intervals over rounds, and writes the same as JSON. Goals: the
edge adds at most 1.5 times as much as ``bare`` and 0.4 times as much as LiteLLM, and answers at least 0.6 and 3 times
as many requests a second. The processor time a request is that of the service's processes, the store's writer among
them. ``--before`` names another checkout of this repository, for example of the last commit, with its virtual
environment in ``.venv``: its edge, as (c), is measured in the same rounds.
The first run installs LiteLLM into a virtual environment of its own under runs/; --litellm none omits it.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import tyro
from processor_time import processor_s
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from lab.experiments.intervals import paired
from simulator.flying.local_edge import HOST, usable_port

LITELLM = "litellm[proxy]==1.106.2"
FLEET, SENSORS = 3, 10
# Milliseconds, milliseconds, requests a second, and milliseconds of processor time a request.
QUANTITIES = ("p50", "p99", "rps", "cpu")
HERE = Path(__file__).parent
EDGE = {
    "AICVDS_MODE": "llm",
    "AICVDS_PLANNER": "off",
    "AICVDS_LOG_LEVEL": "warning",
    # The LLM server's first alternative would sometimes break a hard rule, and the policy's answer would be measured.
    "AICVDS_VERIFY": "off",
    # Answers without the LLM must not hide the slowness of a busy machine.
    "AICVDS_DEADLINE_MS": "20000",
}
# The services that the edge is compared to, with the highest ratio of latencies and the lowest of requests a second.
GOALS = {"bare": (1.5, 0.6), "litellm": (0.4, 3.0), "before": None}


@dataclass(frozen=True)
class Overhead:
    """Put load on the edge, on a bare forwarder and on LiteLLM's proxy."""

    rounds: int = 6
    """Rounds; each measures all targets, one after the other."""
    seconds: float = 2.0
    """Seconds of each measurement, at each number of UAVs."""
    uavs: tuple[int, ...] = (3, 64)
    """Numbers of concurrent UAVs."""
    litellm: str = "install"
    """`install`, the path of a `litellm` program, or `none`."""
    before: Path | None = None
    """Another checkout, whose edge is measured beside this one's."""
    out: Path = Path("runs/overhead.json")
    """Where to write the figures."""


@dataclass
class Uav:
    """One UAV: it reports, gets a decision, and reports again with the decision's outcome."""

    number: int
    told: dict[str, Any] = field(default_factory=dict)
    step: int = 0

    @property
    def mission(self) -> str:
        """Its fleet's."""
        return f"fleet{self.number // FLEET}"

    def report(self, outcomes: bool) -> bytes:
        """The next request's body."""
        random = np.random.default_rng([self.number, self.step])
        body: dict[str, Any] = {
            "mission_id": self.mission,
            "step": self.step,
            "uav_id": self.number % FLEET,
            "position": [500.0, 450.0],
            "sensors": {
                "id": list(range(SENSORS)),
                "x": [100.0 * n for n in range(SENSORS)],
                "y": [90.0 * n for n in range(SENSORS)],
                "queue": [float(q) for q in random.integers(0, 60, SENSORS)],
                "battery": [40.0] * SENSORS,
                "channel_gain": [round(float(g), 1) for g in random.uniform(-110, -80, SENSORS)],
                "last_seen": [self.step] * SENSORS,
            },
        }
        if outcomes and self.told:
            body["outcome"] = {"decision_id": self.told["decision_id"], "cost": 0.2, "failed": False}
        self.step += 1
        return json.dumps(body).encode()


@dataclass(frozen=True)
class Target:
    """A service under load: its process, its URL, its key, and the requests of a UAV."""

    name: str
    process: int
    port: int
    path: str
    body: Callable[[Uav], bytes]
    key: str | None = None

    def request(self, uav: Uav) -> bytes:
        """The UAV's next request, with its headers."""
        body = self.body(uav)
        key = f"Authorization: Bearer {self.key}\r\n" if self.key else ""
        head = f"POST {self.path} HTTP/1.1\r\nHost: {HOST}\r\nContent-Type: application/json\r\n{key}"
        return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def make_missions(edge: Target, uavs: Iterable[Uav]) -> None:
    """Make the missions of UAVs that an edge is to decide for."""
    for mission in {uav.mission for uav in uavs}:
        url, bearer = f"http://{HOST}:{edge.port}/missions/{mission}", {"Authorization": f"Bearer {edge.key}"}
        httpx.put(url, json={}, headers=bearer, timeout=60).raise_for_status()


async def _flies(target: Target, uav: Uav, ends: float, took_ms: list[float]) -> None:
    reader, writer = await asyncio.open_connection(HOST, target.port)
    try:
        while time.perf_counter() < ends:
            asked = target.request(uav)
            began = time.perf_counter()
            writer.write(asked)
            head = await reader.readuntil(b"\r\n\r\n")
            length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
            answer = await reader.readexactly(length)
            took_ms.append((time.perf_counter() - began) * 1e3)
            if not head.startswith(b"HTTP/1.1 200"):
                raise SystemExit(f"{target.name}: {answer[:500].decode()}")
            uav.told = json.loads(answer)
            # The LLM may answer concurrent UAVs with the same sensor, and the edge then gives one of them another.
            if uav.told.get("reason") not in (None, "answer_reserved"):
                raise SystemExit(f"{target.name}: the LLM was not heard: {uav.told['reason']}")
    finally:
        writer.close()


def load(target: Target, uavs: list[Uav], seconds: float) -> dict[str, float]:
    """p50 and p99 in ms, answers a second, and processor time an answer in ms, of UAVs that ask at once."""

    async def all_of_them() -> tuple[list[float], float]:
        took_ms: list[float] = []
        began = time.perf_counter()
        await asyncio.gather(*(_flies(target, uav, began + seconds, took_ms) for uav in uavs))
        return took_ms, time.perf_counter() - began

    busy_s = processor_s(target.process)
    took_ms, lasted = asyncio.run(all_of_them())
    busy_s = processor_s(target.process) - busy_s
    p50, p99 = np.percentile(took_ms, [50, 99])
    cpu = busy_s * 1e3 / len(took_ms)
    return {"p50": float(p50), "p99": float(p99), "rps": len(took_ms) / lasted, "cpu": cpu}


@contextmanager
def running(
    command: list[str], health: str, env: dict[str, str] | None = None, folder: Path | None = None
) -> Iterator[int]:
    """A service as a process that answers ``health`` with 200; yields the process's ID."""
    process = subprocess.Popen(command, env={**os.environ, **(env or {})}, cwd=folder, stdout=subprocess.DEVNULL)
    try:
        ends = time.monotonic() + 120
        while True:
            try:
                if httpx.get(health, timeout=5).status_code == 200:
                    break
            except httpx.HTTPError:
                pass
            if process.poll() is not None or time.monotonic() > ends:
                raise SystemExit(f"{' '.join(command)}: did not start")
            time.sleep(0.1)
        yield process.pid
    finally:
        process.terminate()
        process.wait(30)


def litellm_program(choice: str, console: Console) -> str | None:
    """LiteLLM's program, installed on request."""
    if choice == "none":
        return None
    if choice != "install":
        return choice
    home = Path("runs/litellm").absolute()
    program = home / "bin/litellm"
    if not program.exists():
        with console.status(f"installing {LITELLM} under {home.parent.name}/{home.name}"):
            subprocess.run([sys.executable, "-m", "venv", home], check=True)
            subprocess.run([home / "bin/pip", "install", "--quiet", LITELLM], check=True)
    return str(program)


def edge_of(settings: dict[str, str], stack: ExitStack, checkout: Path | None = None) -> tuple[int, int]:
    """Start an edge of this checkout or another, and wait for its LLM; returns its process and its port."""
    port = usable_port(0)
    python = str(checkout / ".venv/bin/python") if checkout else sys.executable
    serve = [python, "-m", "shared.kit.command_line", "serve", "--host", HOST, "--port", str(port)]
    process = stack.enter_context(running(serve, f"http://{HOST}:{port}/healthz", settings, checkout))
    while httpx.get(f"http://{HOST}:{port}/readyz", timeout=60).json()["llm"] != "ready":
        time.sleep(0.1)
    return process, port


def start(folder: Path, litellm: str | None, before: Path | None, stack: ExitStack) -> list[Target]:
    """Start all targets; the first is the LLM server itself."""
    llm, bare, proxy = (usable_port(0) for _ in range(3))
    python, upstream = sys.executable, f"http://{HOST}:{llm}/v1"
    instant = [python, str(HERE / "instant_llm.py"), "--port", str(llm)]
    server = stack.enter_context(running(instant, f"{upstream}/models"))
    forwarder = [python, str(HERE / "bare_forwarder.py"), "--port", str(bare), "--upstream", upstream]
    forwards = stack.enter_context(running(forwarder, f"http://{HOST}:{bare}/healthz"))
    keys = folder / "keys.json"
    add = ["keys", "add", "load", "--file", str(keys), "--scopes", "decide", "admin", "--per-minute", "1000000"]
    made = subprocess.run([python, "-m", "shared.kit.command_line", *add], check=True, capture_output=True, text=True)
    key = made.stdout.split()[-1]
    settings = {**EDGE, "AICVDS_LLM_URL": upstream, "AICVDS_KEYS": str(keys)}
    edge = edge_of({**settings, "AICVDS_STORE": str(folder / "missions.db")}, stack)
    storeless = edge_of({**settings, "AICVDS_STORE": "none"}, stack)
    targets = [
        Target("bare", forwards, bare, "/decide", lambda uav: uav.report(outcomes=False)),
        Target("edge", *edge, "/decide", lambda uav: uav.report(outcomes=True), key),
        Target("edge, no outcomes", *edge, "/decide", lambda uav: uav.report(outcomes=False), key),
        Target("edge, no store", *storeless, "/decide", lambda uav: uav.report(outcomes=True), key),
    ]
    if before is not None:
        other = edge_of({**settings, "AICVDS_STORE": str(folder / "before.db")}, stack, before.absolute())
        targets.insert(2, Target("before", *other, "/decide", lambda uav: uav.report(outcomes=True), key))
    # LiteLLM is to forward the edge's own query.
    first = [Uav(n) for n in range(FLEET)]
    make_missions(targets[1], first)
    load(targets[1], first, 1.0)
    asked = httpx.get(f"http://{HOST}:{llm}/last").json()
    chat = json.dumps({"model": "instant", "messages": asked["messages"], "temperature": 0, "max_tokens": 12}).encode()
    if litellm is not None:
        model = {"model": "openai/instant", "api_base": upstream, "api_key": "none"}
        master = "sk-" + secrets.token_hex(32)
        config = folder / "litellm.json"
        config.write_text(json.dumps({"model_list": [{"model_name": "instant", "litellm_params": model}]}))
        command = [litellm, "--config", str(config), "--host", HOST, "--port", str(proxy)]
        offline = {"LITELLM_LOCAL_MODEL_COST_MAP": "True", "LITELLM_LOG": "ERROR", "LITELLM_MASTER_KEY": master}
        lite = stack.enter_context(running(command, f"http://{HOST}:{proxy}/health/liveliness", offline))
        targets.append(Target("litellm", lite, proxy, "/v1/chat/completions", lambda _: chat, master))
    return [Target("direct", server, llm, "/v1/chat/completions", lambda _: chat), *targets]


Figures = dict[str, dict[int, dict[str, list[float]]]]


def measure(targets: list[Target], options: Overhead, console: Console) -> Figures:
    """By target, number of UAVs and quantity: one value a round."""
    found: Figures = {t.name: {n: {q: [] for q in QUANTITIES} for n in options.uavs} for t in targets}
    # Each target's UAVs continue their missions from round to round; the edge's two kinds fly separate missions.
    fleets = {t.name: [Uav(999 * i + n) for n in range(max(options.uavs))] for i, t in enumerate(targets)}
    for target in targets:
        if target.name.startswith(("edge", "before")):
            make_missions(target, fleets[target.name])
    with Progress(console=console) as progress:
        task = progress.add_task("measuring", total=(options.rounds + 1) * len(targets) * len(options.uavs))
        for turn in range(options.rounds + 1):
            for target in targets:
                for count in options.uavs:
                    figures = load(target, fleets[target.name][:count], options.seconds)
                    # The first round warms up.
                    for quantity, value in figures.items() if turn else ():
                        found[target.name][count][quantity].append(value)
                    progress.advance(task)
    return found


def compare(found: Figures, uavs: tuple[int, ...]) -> list[dict[str, Any]]:
    """Medians, and the edge's ratios to the others with their intervals."""
    rows = []
    for count in uavs:
        for name, by_count in found.items():
            row: dict[str, Any] = {"service": name, "uavs": count}
            for quantity in QUANTITIES:
                row[quantity] = round(float(np.median(by_count[count][quantity])), 2)
            if name.startswith("edge"):
                # `before` does all that `edge` does.
                for other in (o for o in GOALS if o in found and (o != "before" or name == "edge")):
                    row[f"to {other}"] = {q: _ratio(found, name, other, count, q) for q in QUANTITIES}
            rows.append(row)
    return rows


def _ratio(found: Figures, name: str, other: str, count: int, quantity: str) -> list[float]:
    mine, its = (np.array(found[n][count][quantity]) for n in (name, other))
    if quantity in ("p50", "p99"):
        direct = np.array(found["direct"][count][quantity])
        mine, its = mine - direct, its - direct
    told = next(p for p in paired(name, other, quantity, list(mine), list(its)) if p.kind == "ratio")
    return [round(value, 2) for value in (told.mean, told.low, told.high)]


def tell(rows: list[dict[str, Any]], console: Console) -> None:
    """Print each target's figures, and the edge's ratios with their goals."""
    taken = Table("UAVs", "service", "p50 ms", "p99 ms", "requests/s", "processor ms")
    for row in rows:
        taken.add_row(str(row["uavs"]), row["service"], *(f"{row[q]:.2f}" for q in QUANTITIES))
    console.print(taken)
    names = {"p50": "added p50", "p99": "added p99", "rps": "requests/s", "cpu": "processor time"}
    ratios = Table("UAVs", "service", "to", "what", "ratio [95%]", "goal")
    for row in rows:
        for other in (o for o in GOALS if f"to {o}" in row):
            for quantity in QUANTITIES:
                value, low, high = row[f"to {other}"][quantity]
                ratio = f"{value:.2f} [{low:.2f}, {high:.2f}]"
                ratios.add_row(str(row["uavs"]), row["service"], other, names[quantity], ratio, _goal(other, quantity))
    console.print(ratios)


def _goal(other: str, quantity: str) -> str:
    limits = GOALS[other]
    if limits is None or quantity == "cpu":
        return ""
    most, least = limits
    return f"at least {least:g}" if quantity == "rps" else f"at most {most:g}"


def main(options: Overhead) -> None:
    """Measure, print, write."""
    console = Console()
    program = litellm_program(options.litellm, console)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        with console.status("starting"):
            targets = start(Path(folder), program, options.before, stack)
        found = measure(targets, options, console)
    rows = compare(found, options.uavs)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"rounds": options.rounds, "rows": rows}, indent=2) + "\n")
    tell(rows, console)


if __name__ == "__main__":
    main(tyro.cli(Overhead, description=__doc__))
