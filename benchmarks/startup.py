"""The time to start: `aicvds serve`, the imports of its parts, and `--help` of every command.

    python -m benchmarks.startup --rounds 10

A round measures by the clock, from the start of a process: `python -c "import numba, fastapi"`; `aicvds serve`
in its ordinary configuration (SQLite, mode guided, planner, the embedded LLM loading) until /healthz answers 200;
the same until the answer to a decision requested at once; `aicvds --help`, and every command's. It prints medians,
and the ratio of /healthz to the imports with its 95% bootstrap interval over rounds, and writes the same as JSON.
Rounds are interleaved, so that other work on the machine affects all. A warm-up round does not count: it
compiles, fills the disk's cache and makes the store, so the benchmark measures a repeated start.
"""

from __future__ import annotations

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

from benchmarks.harness import Goal, Options, Report, environment, in_turn, run
from lab.experiments.intervals import ratio_of_medians
from service.api.openapi import REQUESTS

GOAL_RATIO, GOAL_DECIDE_S, GOAL_HELP_S = 1.5, 2.0, 0.3
AICVDS = str(Path(sys.executable).with_name("aicvds"))
IMPORTS, HEALTHZ, DECIDE, HELP = "import numba, fastapi", "serve: /healthz", "serve: /decide", "--help"


@dataclass(frozen=True)
class Startup(Options):
    """Start everything repeatedly, in turns."""

    rounds: int = 10
    """Measured starts of each."""


def measure(args: Startup) -> Report:
    """Start everything in turn; raises ``SystemExit`` without the embedded LLM."""
    with tempfile.TemporaryDirectory() as folder:
        # The benchmark times one request, which makes its mission.
        env = environment({"STORE": f"{folder}/missions.db", "CREATE_ON_DECIDE": "on"})
        with _edge(env) as (client, _):
            if (llm := client.get("/readyz").json()["llm"]) not in ("loading", "ready"):
                raise SystemExit(f"The embedded LLM is {llm}: run `aicvds model fetch` first.")
        seconds = in_turn(_timed(env), args.rounds, warm_up=1)
    ratios = {name: ratio_of_medians(seconds[name], seconds[IMPORTS]) for name in (HEALTHZ, DECIDE)}
    medians = {name: float(np.median(took)) for name, took in seconds.items()}
    found = {
        "rounds": args.rounds,
        "median_s": {name: round(median, 3) for name, median in medians.items()},
        "seconds": {name: [round(one, 4) for one in took] for name, took in seconds.items()},
        "healthz_to_imports": dict(zip(("ratio", "low", "high"), ratios[HEALTHZ], strict=True)),
        "decide_to_imports": dict(zip(("ratio", "low", "high"), ratios[DECIDE], strict=True)),
    }
    rows = {
        name: {"median s": medians[name], "least": min(took), "most": max(took), "to the imports": ratios.get(name, "")}
        for name, took in seconds.items()
    }
    goals = [
        Goal(f"{HEALTHZ}, to the imports", ratios[HEALTHZ], most=GOAL_RATIO),
        Goal(f"{DECIDE}, s", medians[DECIDE], most=GOAL_DECIDE_S),
        Goal(f"aicvds {HELP}, s", medians[HELP], most=GOAL_HELP_S),
    ]
    return Report(found, {"Starts": rows}, goals)


def _timed(env: dict[str, str]) -> dict[str, Callable[[int], float]]:
    """The starts of a round, in order; each returns seconds."""
    commands = sorted(entry.name for entry in entry_points(group="aicvds.commands"))
    helps = [[HELP], *([command, HELP] for command in commands)]
    return {
        IMPORTS: lambda _: _ended([sys.executable, "-c", IMPORTS], env),
        HEALTHZ: lambda _: _served(env, lambda client: client.get("/healthz")),
        DECIDE: lambda _: _served(env, lambda client: client.post("/decide", json=_request())),
        **{" ".join(args): lambda _, args=args: _ended([AICVDS, *args], env) for args in helps},  # type: ignore[misc]
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
                line = process.stderr.readline()
                address = re.search(r"http://[\d.:]+", line)
                if address is None:
                    raise SystemExit(f"aicvds serve did not start: {line}{process.stderr.read()}")
                client.base_url = address[0]
                yield client, began
            finally:
                process.terminate()
                process.stderr.read()


if __name__ == "__main__":
    run(Startup, measure)
