"""The time to start: `aicvds serve` beside the imports of its parts, and `--help` of every command.

    python benchmarks/startup.py --rounds 10

A round measures by the clock, from the start of a process: `python -c "import torch, fastapi"`; `aicvds serve`
in its ordinary configuration (SQLite, mode guided, planner, the embedded LLM loading) until /healthz answers 200;
the same until the answer to a decision requested at once; `aicvds --help`, and every command's. It prints medians,
and the ratio of /healthz to the imports with its 95% bootstrap interval over rounds, and writes the same as JSON.
Rounds are interleaved, so that other work on the machine affects all. A warm-up round does not count: it
compiles, fills the disk's cache and makes the store, so the benchmark measures a repeated start.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

import httpx
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import bootstrap

from service.api.openapi_examples import REQUESTS

GOAL_RATIO, GOAL_HELP_S = 1.5, 0.3
AICVDS = str(Path(sys.executable).with_name("aicvds"))
IMPORTS, HEALTHZ, DECIDE, HELP = "import torch, fastapi", "serve: /healthz", "serve: /decide", "--help"


@dataclass(frozen=True)
class Startup:
    """Start everything repeatedly, in turns."""

    rounds: int = 10
    """Measured starts of each."""
    out: Path = Path("runs/startup.json")
    """Where to write."""


def main(args: Startup) -> int:
    """Measure, print, write."""
    console = Console()
    with tempfile.TemporaryDirectory() as folder:
        env = _ordinary(Path(folder) / "missions.db")
        timed = _timed(env)
        if (llm := _llm(env)) not in ("loading", "ready"):
            console.print(f"[red]The embedded LLM is {llm}: run `aicvds model fetch` first.")
            return 1
        seconds: dict[str, list[float]] = {name: [] for name in timed}
        for counted in track([False] + [True] * args.rounds, "Starting", console=console):
            for name, run in timed.items():
                took = run()
                if counted:
                    seconds[name].append(took)
    healthz, decide = (_ratio(seconds[name], seconds[IMPORTS]) for name in (HEALTHZ, DECIDE))
    found = {
        "rounds": args.rounds,
        "command": sys.argv,
        "median_s": {name: round(float(np.median(took)), 3) for name, took in seconds.items()},
        "seconds": {name: [round(one, 4) for one in took] for name, took in seconds.items()},
        "healthz_to_imports": healthz,
        "decide_to_imports": decide,
        "goal_ratio": GOAL_RATIO,
        "goal_help_s": GOAL_HELP_S,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    console.print(_table(seconds, healthz, decide))
    return 0


def _ordinary(store: Path) -> dict[str, str]:
    """This environment without its settings, except the model's folder, and with a store of its own."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("AICVDS_", "OTEL_"))}
    env |= {name: os.environ[name] for name in ("AICVDS_CACHE_DIR",) if name in os.environ}
    # What is timed is one request, which makes its mission.
    return env | {"AICVDS_STORE": str(store), "AICVDS_CREATE_ON_DECIDE": "on"}


def _timed(env: dict[str, str]) -> dict[str, Callable[[], float]]:
    """The starts of a round, in order; each returns seconds."""
    commands = sorted(entry.name for entry in entry_points(group="aicvds.commands"))
    helps = [[HELP], *([command, HELP] for command in commands)]
    return {
        IMPORTS: lambda: _ended([sys.executable, "-c", IMPORTS], env),
        HEALTHZ: lambda: _served(env, lambda client: client.get("/healthz")),
        DECIDE: lambda: _served(env, lambda client: client.post("/decide", json=_request())),
        **{" ".join(words): lambda words=words: _ended([AICVDS, *words], env) for words in helps},  # type: ignore[misc]
    }


def _request() -> dict[str, object]:
    """The first request of a new mission, which is not in the store, with a deadline that a busy machine can meet."""
    return {**REQUESTS["post /decide"]["paper"]["value"], "mission_id": uuid.uuid4().hex, "deadline_ms": 60_000}


def _ended(command: list[str], env: dict[str, str]) -> float:
    """Seconds from the start of a process to its end."""
    began = time.perf_counter()
    subprocess.run(command, env=env, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def _served(env: dict[str, str], ask: Callable[[httpx.Client], httpx.Response]) -> float:
    """Seconds from the start of an edge to its answer to a request sent as soon as it has a port."""
    with _edge(env) as (client, began):
        ask(client).raise_for_status()
        return time.perf_counter() - began


def _llm(env: dict[str, str]) -> str:
    """The state of an edge's LLM."""
    with _edge(env) as (client, _):
        return str(client.get("/readyz").json()["llm"])


@contextmanager
def _edge(env: dict[str, str]) -> Iterator[tuple[httpx.Client, float]]:
    """A client of an edge that has just printed its port, and the time of the process's start."""
    # The client is made before the start, so that its own start does not count.
    with httpx.Client(timeout=120, trust_env=False) as client:
        began = time.perf_counter()
        command = [AICVDS, "serve", "--port", "0"]
        with subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            try:
                told = process.stderr.readline()
                address = re.search(r"http://[\d.:]+", told)
                if address is None:
                    raise SystemExit(f"aicvds serve did not start: {told}{process.stderr.read()}")
                client.base_url = address[0]
                yield client, began
            finally:
                process.terminate()
                process.stderr.read()


def _ratio(above: list[float], below: list[float]) -> dict[str, float]:
    """Ratio of medians, and its 95% percentile bootstrap interval over rounds."""

    def ratio(a: NDArray[np.float64], b: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        return np.asarray(np.median(a, axis=axis) / np.median(b, axis=axis))

    rounds = (np.array(above), np.array(below))
    told = {"ratio": float(ratio(*rounds))}
    if len(above) > 1:
        interval = bootstrap(rounds, ratio, paired=True, method="percentile", rng=0).confidence_interval
        told |= {"low": float(interval.low), "high": float(interval.high)}
    return {name: round(value, 3) for name, value in told.items()}


def _table(seconds: dict[str, list[float]], healthz: dict[str, float], decide: dict[str, float]) -> Table:
    table = Table("", "median s", "least", "most", "to the imports", "goal", title=f"{len(seconds[HELP])} rounds")
    ratios = {HEALTHZ: healthz, DECIDE: decide}
    goals = {HEALTHZ: f"< {GOAL_RATIO}", HELP: f"< {GOAL_HELP_S} s"}
    for name, took in seconds.items():
        ratio = ratios.get(name, {})
        told = f"{ratio['ratio']:.2f} [{ratio.get('low', 0):.2f}, {ratio.get('high', 0):.2f}]" if ratio else ""
        row = (name, f"{np.median(took):.2f}", f"{min(took):.2f}", f"{max(took):.2f}", told, goals.get(name, ""))
        table.add_row(*row)
    return table


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Startup, description=__doc__)))
