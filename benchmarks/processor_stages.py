"""Where the edge's processor time of a decision goes, by stage.

    python -m benchmarks.processor_stages

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
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import FrameType

import numpy as np
import psutil

from benchmarks.harness import Goal, Options, Report, edge, in_turn, instant_llm, run
from benchmarks.load import EDGE, FLEET, Target, Uav, load, made_key, make_missions

# The first argument of the sampled process; a file and `serve`'s options follow.
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
# The highest sum of all stages.
GOAL_MS = 0.8
OTHER, WRITER = "event loop and others", "the process that writes SQLite"


@dataclass(frozen=True)
class ProcessorStages(Options):
    """Sample the edge's processor time under load."""

    rounds: int = 5
    """Rounds."""
    seconds: float = 8.0
    """Seconds of load in each round."""


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


def serve_sampled(out: str, *options: str) -> None:
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
    serve.load()(list(options))


def sampled(options: ProcessorStages) -> list[dict[str, float]]:
    """Milliseconds of processor time a decision, by stage, of each round."""
    with tempfile.TemporaryDirectory() as name, instant_llm() as llm:
        keys, samples = Path(name) / "keys.json", Path(name) / "samples.json"
        key, settings = made_key(keys), {**EDGE, "LLM_URL": f"{llm.url}/v1", "KEYS": keys}
        with edge(settings, serve=("benchmarks.processor_stages", SAMPLED, str(samples))) as server:
            target = Target("edge", server, lambda uav: uav.report(outcomes=True), key)
            uavs = [Uav(number) for number in range(FLEET)]
            make_missions(target, uavs)
            load(target, uavs, 2.0)
            return in_turn({0: lambda _: _round(target, uavs, samples, options.seconds)}, options.rounds)[0]


def _round(target: Target, uavs: list[Uav], samples: Path, seconds: float) -> dict[str, float]:
    first = target.server.process
    (writer,) = first.children()
    before, written, steps = _busy_s(first), _busy_s(writer), sum(uav.step for uav in uavs)
    os.kill(first.pid, signal.SIGUSR1)
    load(target, uavs, seconds)
    os.kill(first.pid, signal.SIGUSR1)
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


def measure(options: ProcessorStages) -> Report:
    """Sample, and take means over rounds."""
    rounds = sampled(options)
    random = np.random.default_rng(0)
    stages = {}
    for name in [name for name in rounds[0] if name != "samples"]:
        values = np.array([each[name] for each in rounds])
        means = values[random.integers(0, len(values), (2000, len(values)))].mean(1)
        low, high = np.percentile(means, [2.5, 97.5])
        stages[name] = [round(float(value), 3) for value in (values.mean(), low, high)]
    whole, column = sum(mean for mean, _, _ in stages.values()), "processor ms a decision [95%]"
    rows = {name: {column: mean} for name, mean in sorted(stages.items(), key=lambda row: -row[1][0])}
    title = f"{sum(each['samples'] for each in rounds):.0f} samples"
    goals = [Goal("processor ms a decision", whole, most=GOAL_MS)]
    return Report({"rounds": rounds, "stages": stages}, {title: rows}, goals)


if __name__ == "__main__":
    if sys.argv[1:2] == [SAMPLED]:
        serve_sampled(*sys.argv[2:])
    else:
        run(ProcessorStages, measure)
