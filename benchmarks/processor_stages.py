"""Where the edge's processor time of a decision goes, by stage.

    python benchmarks/processor_stages.py

Before an LLM server that answers at once there is `aicvds serve` in mode ``llm`` with everything on, as in
``overhead.py``: 3 UAVs send their next request, with an outcome, after each answer. A timer of the process's own
processor time (``ITIMER_PROF``, one sample each tick of the kernel, 4 ms here) interrupts the event loop. A sample
belongs to the innermost frame of the package ``service``, else to the innermost library of the table, so that numpy's,
pydantic's and the kernel's time counts for the stage that called them. Samples say the shares; the processor time a
decision is the kernel's count. It prints means over rounds with 95% bootstrap intervals, and writes JSON.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import FrameType

import httpx
import numpy as np
import psutil
import tyro
from overhead import EDGE, FLEET, HERE, Target, Uav, load, make_missions, running
from rich.console import Console
from rich.progress import track
from rich.table import Table

from simulator.flying.local_edge import HOST, usable_port

# The first argument of the sampled process; a file and the port follow.
SAMPLED = "sampled"
# Folders of the package `service`, and libraries whose frames have none of `service` beneath them.
STAGES = {
    "service/server": "HTTP",
    "service/api": "validation, keys, limits",
    "service/edge": "engine",
    "service/mission": "report and belief",
    "service/deciding": "attention and choice",
    "service/prompting": "prompt and tokens",
    "service/llm": "LLM client",
    "service/learning": "learning",
    "service/storage": "journal",
    "service/observability": "metrics and logs",
    "service/live": "page",
    "uvicorn": "HTTP",
    "starlette": "HTTP",
    "fastapi": "HTTP",
    "aiohttp": "LLM client",
}
OTHER, WRITER = "event loop and others", "the process that writes SQLite"


@dataclass(frozen=True)
class ProcessorStages:
    """Sample the edge's processor time under load."""

    rounds: int = 5
    """Rounds."""
    seconds: float = 8.0
    """Seconds of load in each round."""
    out: Path = Path("runs/processor_stages.json")
    """Where to write the figures."""


def stage(frame: FrameType | None) -> str:
    """The stage that a frame and its callers belong to."""
    library = OTHER
    while frame is not None:
        file = frame.f_code.co_filename
        if "/service/" in file:
            folder = "service/" + file.rsplit("/service/", 1)[1].split("/")[0]
            return STAGES.get(folder, OTHER)
        if library == OTHER and "/site-packages/" in file:
            library = STAGES.get(file.rsplit("/site-packages/", 1)[1].split("/")[0], OTHER)
        frame = frame.f_back
    return library


def serve_sampled(out: str, port: str) -> None:
    """Serve; SIGUSR1 begins to count samples, and the next one writes them."""
    counted: Counter[str] = Counter()
    sampling = False

    def sample(_: int, frame: FrameType | None) -> None:
        counted[stage(frame)] += 1

    def switch(*_: object) -> None:
        nonlocal sampling
        sampling = not sampling
        signal.setitimer(signal.ITIMER_PROF, *((0.001, 0.001) if sampling else (0.0, 0.0)))
        if not sampling:
            part = Path(out + ".part")
            part.write_text(json.dumps(counted))
            part.rename(out)
            counted.clear()

    signal.signal(signal.SIGPROF, sample)
    signal.signal(signal.SIGUSR1, switch)
    (serve,) = entry_points(group="aicvds.commands", name="serve")
    serve.load()(["--host", HOST, "--port", port])


def measure(options: ProcessorStages, console: Console) -> list[dict[str, float]]:
    """Milliseconds of processor time a decision, by stage, of each round."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        llm, port = usable_port(0), usable_port(0)
        upstream, keys = f"http://{HOST}:{llm}/v1", folder / "keys.json"
        instant = [sys.executable, str(HERE / "instant_llm.py"), "--port", str(llm)]
        stack.enter_context(running(instant, f"{upstream}/models"))
        add = ["keys", "add", "load", "--file", str(keys), "--scopes", "decide", "admin", "--per-minute", "1000000"]
        made = subprocess.run(
            [sys.executable, "-m", "shared.kit.command_line", *add], check=True, capture_output=True, text=True
        )
        key = made.stdout.split()[-1]
        settings = {"LLM_URL": upstream, "KEYS": str(keys), "STORE": str(folder / "missions.db")}
        environment = {**EDGE, **{f"AICVDS_{name}": value for name, value in settings.items()}}
        edge = [sys.executable, __file__, SAMPLED, str(folder / "samples.json"), str(port)]
        process = stack.enter_context(running(edge, f"http://{HOST}:{port}/healthz", environment))
        while httpx.get(f"http://{HOST}:{port}/readyz", timeout=60).json()["llm"] != "ready":
            time.sleep(0.1)
        target = Target("edge", process, port, "/decide", lambda uav: uav.report(outcomes=True), key)
        uavs = [Uav(number) for number in range(FLEET)]
        make_missions(target, uavs)
        load(target, uavs, 2.0)
        rounds = range(options.rounds)
        return [
            _round(target, uavs, folder / "samples.json", options.seconds)
            for _ in track(rounds, "sampling", console=console)
        ]


def _round(target: Target, uavs: list[Uav], samples: Path, seconds: float) -> dict[str, float]:
    first, (writer,) = psutil.Process(target.process), psutil.Process(target.process).children()
    before, steps = _busy_s(first), sum(uav.step for uav in uavs)
    written = _busy_s(writer)
    os.kill(target.process, signal.SIGUSR1)
    load(target, uavs, seconds)
    os.kill(target.process, signal.SIGUSR1)
    busy_ms, written_ms = 1e3 * (_busy_s(first) - before), 1e3 * (_busy_s(writer) - written)
    while not samples.exists():
        time.sleep(0.01)
    counted = json.loads(samples.read_text())
    samples.unlink()
    decisions, taken = sum(uav.step for uav in uavs) - steps, sum(counted.values())
    found = {stage: busy_ms * counted.get(stage, 0) / taken / decisions for stage in {*STAGES.values(), OTHER}}
    return {**found, WRITER: written_ms / decisions, "samples": taken}


def _busy_s(process: psutil.Process) -> float:
    """Seconds of processor time of one process."""
    times = process.cpu_times()
    return float(times.user + times.system)


def main(options: ProcessorStages) -> None:
    """Measure, print, write."""
    console = Console()
    rounds = measure(options, console)
    random = np.random.default_rng(0)
    rows = {}
    for name in [name for name in rounds[0] if name != "samples"]:
        values = np.array([each[name] for each in rounds])
        means = values[random.integers(0, len(values), (2000, len(values)))].mean(1)
        low, high = np.percentile(means, [2.5, 97.5])
        rows[name] = [round(float(value), 3) for value in (values.mean(), low, high)]
    table = Table("stage", "processor ms a decision [95%]", title=f"{sum(r['samples'] for r in rounds)} samples")
    for name, (mean, low, high) in sorted(rows.items(), key=lambda row: -row[1][0]):
        table.add_row(name, f"{mean:.3f} [{low:.3f}, {high:.3f}]")
    table.add_row("all", f"{sum(mean for mean, _, _ in rows.values()):.3f}")
    console.print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"rounds": rounds, "stages": rows}, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == [SAMPLED]:
        serve_sampled(*sys.argv[2:])
    else:
        main(tyro.cli(ProcessorStages, description=__doc__))
