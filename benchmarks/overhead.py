"""The latency that the edge adds to an LLM that answers at once, compared with a bare forwarder and LiteLLM's proxy.

    python -m benchmarks.overhead

These services, each a process of its own on loopback, query an LLM server that answers at once (``instant_llm.py``):
(a) ``bare``, a FastAPI application that only forwards the same JSON with httpx; (b) ``litellm``, LiteLLM's proxy with
the same prompt as a chat completion, behind its one key; (c) ``edge``, ``POST /decide`` in mode ``llm`` with everything
on: keys, attention, prompt, token counting, checks, SQLite store, metrics, and outcomes that it learns from;
(d) ``edge, no outcomes``: the same without outcomes; (e) ``edge, no store``: as (c), but in memory only. 3 and 64 UAVs
send their next request after each answer. Every round measures all of (a) to (e), so that other work on the
machine slows all. Added latency is the latency at the UAV less that of the LLM server with the same load generator.
It prints medians over rounds and their ratios with 95% bootstrap intervals over rounds, and writes the same as JSON.
Goals: the edge adds at most 1.5 times as much as ``bare`` and 0.4 times as much as LiteLLM, and answers at least 0.6
and 3 times as many requests a second. The processor time a request is that of the service's processes, including the
store's writer. ``--before`` names another checkout of this repository, for example of the last commit, with its
virtual environment in ``.venv``; the rounds then also measure its edge, as (c).
The first run installs LiteLLM into a virtual environment of its own under runs/; --litellm none omits it.
"""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import rich

from benchmarks.harness import Cell, Goal, Options, Report, edge, environment, in_turn, instant_llm, run, running
from benchmarks.load import EDGE, FLEET, Target, Uav, load, made_key, make_missions
from lab.experiments.intervals import paired
from simulator.flying.local_edge import HOST, usable_port

LITELLM = "litellm[proxy]==1.106.2"
QUANTITIES = {"p50": "p50 ms", "p99": "p99 ms", "rps": "requests/s", "cpu": "processor ms"}
# Latencies are compared after subtracting the LLM server's own.
RATIOS = {"p50": "added p50", "p99": "added p99", "rps": "requests/s", "cpu": "processor time"}
# The services that the edge is compared to, with the highest ratio of latencies and the lowest of requests a second.
GOALS = {"bare": (1.5, 0.6), "litellm": (0.4, 3.0), "before": None}


@dataclass(frozen=True)
class Overhead(Options):
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
    """Another checkout, whose edge is measured too."""


def litellm_program(choice: str) -> str | None:
    """LiteLLM's program, installed on request."""
    if choice == "none":
        return None
    if choice != "install":
        return choice
    home = Path("runs/litellm").absolute()
    program = home / "bin/litellm"
    if not program.exists():
        with rich.get_console().status(f"installing {LITELLM} under {home.parent.name}/{home.name}"):
            subprocess.run([sys.executable, "-m", "venv", home], check=True)
            subprocess.run([home / "bin/pip", "install", "--quiet", LITELLM], check=True)
    return str(program)


def start(folder: Path, options: Overhead, stack: ExitStack) -> list[Target]:
    """Start all targets; the first is the LLM server itself."""
    llm, keys, port = stack.enter_context(instant_llm()), folder / "keys.json", usable_port(0)
    upstream = f"{llm.url}/v1"
    forwarder = [sys.executable, "-m", "benchmarks.bare_forwarder", str(port), upstream]
    forwards = stack.enter_context(running(forwarder, f"http://{HOST}:{port}", "/healthz"))
    key, settings = made_key(keys), {**EDGE, "LLM_URL": upstream, "KEYS": keys}
    default = stack.enter_context(edge(settings))
    # Each target has an edge of its own: shared missions would double the load on the store and the caches.
    no_outcomes = stack.enter_context(edge(settings))
    storeless = stack.enter_context(edge({**settings, "STORE": "none"}))
    targets = [
        Target("bare", forwards, lambda uav: uav.report(outcomes=False)),
        Target("edge", default, lambda uav: uav.report(outcomes=True), key),
        Target("edge, no outcomes", no_outcomes, lambda uav: uav.report(outcomes=False), key),
        Target("edge, no store", storeless, lambda uav: uav.report(outcomes=True), key),
    ]
    if options.before is not None:
        other = stack.enter_context(edge(settings, options.before))
        targets.insert(2, Target("before", other, lambda uav: uav.report(outcomes=True), key))
    # LiteLLM forwards the query that the edge sends.
    first = [Uav(n) for n in range(FLEET)]
    make_missions(targets[1], first)
    load(targets[1], first, 1.0)
    query = httpx.get(f"{llm.url}/last").json()
    chat = json.dumps({"model": "instant", "messages": query["messages"], "temperature": 0, "max_tokens": 12}).encode()
    if (program := litellm_program(options.litellm)) is not None:
        targets.append(_litellm(program, folder, upstream, chat, stack))
    return [Target("direct", llm, lambda _: chat, path="/v1/chat/completions"), *targets]


def _litellm(program: str, folder: Path, upstream: str, chat: bytes, stack: ExitStack) -> Target:
    port, master = usable_port(0), "sk-" + secrets.token_hex(32)
    model = {"model": "openai/instant", "api_base": upstream, "api_key": "none"}
    config = folder / "litellm.json"
    config.write_text(json.dumps({"model_list": [{"model_name": "instant", "litellm_params": model}]}))
    command = [program, "--config", str(config), "--host", HOST, "--port", str(port)]
    offline = {"LITELLM_LOCAL_MODEL_COST_MAP": "True", "LITELLM_LOG": "ERROR", "LITELLM_MASTER_KEY": master}
    url = f"http://{HOST}:{port}"
    server = stack.enter_context(running(command, url, "/health/liveliness", environment({}) | offline))
    return Target("litellm", server, lambda _: chat, master, "/v1/chat/completions")


Figures = dict[tuple[str, int], list[dict[str, float]]]


def measured(targets: list[Target], options: Overhead) -> Figures:
    """By target and number of UAVs: the quantities of each round."""
    # Each target's UAVs continue their missions from round to round; the edge's two kinds fly separate missions.
    fleets = {t.name: [Uav(999 * i + n) for n in range(max(options.uavs))] for i, t in enumerate(targets)}
    for target in targets:
        if target.name.startswith(("edge", "before")):
            make_missions(target, fleets[target.name])

    def loaded(target: Target, count: int) -> Callable[[int], dict[str, float]]:
        return lambda _: load(target, fleets[target.name][:count], options.seconds)

    variants = {(target.name, count): loaded(target, count) for target in targets for count in options.uavs}
    return in_turn(variants, options.rounds, warm_up=1, alternate=True)


def compared(found: Figures, name: str, other: str, count: int, quantity: str) -> list[float]:
    """A ratio with its interval over rounds."""
    ours, theirs, direct = (np.array([each[quantity] for each in found[n, count]]) for n in (name, other, "direct"))
    if quantity in ("p50", "p99"):
        ours, theirs = ours - direct, theirs - direct
    ratio = next(p for p in paired(name, other, quantity, list(ours), list(theirs)) if p.kind == "ratio")
    return [round(value, 2) for value in (ratio.mean, ratio.low, ratio.high)]


def measure(options: Overhead) -> Report:
    """Start everything, put load on it in turn, and compare."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        found = measured(start(Path(folder), options, stack), options)
    rows: list[dict[str, Any]] = []
    ratios: dict[str, dict[str, Cell]] = {}
    goals: list[Goal] = []
    for (name, count), rounds in sorted(found.items(), key=lambda each: each[0][1]):
        row = {q: round(float(np.median([each[q] for each in rounds])), 2) for q in QUANTITIES}
        rows.append({"service": name, "uavs": count, **row})
        # Only `edge` is compared with `before`, which does the same.
        for other in (o for o in GOALS if (o, count) in found and (name == "edge" or o != "before")):
            if not name.startswith("edge"):
                continue
            to_other = {quantity: compared(found, name, other, count, quantity) for quantity in QUANTITIES}
            rows[-1][f"to {other}"] = to_other
            pair = f"{count} UAVs, {name}, to {other}"
            ratios[pair] = {RATIOS[quantity]: ratio for quantity, ratio in to_other.items()}
            if limits := GOALS[other]:
                goals += [Goal(f"{pair}: {RATIOS[q]}", to_other[q], most=limits[0]) for q in ("p50", "p99")]
                goals.append(Goal(f"{pair}: {RATIOS['rps']}", to_other["rps"], least=limits[1]))
    taken = {f"{row['uavs']} UAVs, {row['service']}": {QUANTITIES[q]: row[q] for q in QUANTITIES} for row in rows}
    figures = {"rounds": options.rounds, "rows": rows}
    return Report(figures, {"Medians over rounds": taken, "Ratios [95% interval]": ratios}, goals)


if __name__ == "__main__":
    run(Overhead, measure)
