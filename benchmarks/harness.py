"""The harness of the benchmarks: it starts edges and servers, repeats variants in turn, prints and writes the figures.

A benchmark is a module of this package. It has a class of options, derived from :class:`Options`, and a function that
measures and returns a :class:`Report`; :func:`run` does the rest. `python -m benchmarks.NAME --help` explains one.
"""

from __future__ import annotations

import inspect
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psutil
import rich
import tyro
from rich.progress import track
from rich.table import Table

from shared.kit.cores import usable_cores
from simulator.flying.local_edge import HOST, usable_port

ROOT = Path(__file__).parents[1]
START_S, STOP_S = 300.0, 30.0
# The only settings that an edge inherits from the caller: those of the machine's paths.
_INHERITED = "AICVDS_CACHE_DIR"

# A text, a number, or a ratio with the bounds of its interval.
Cell = str | float | Sequence[float]
Rows = Mapping[str, Mapping[str, Cell]]


@dataclass(frozen=True)
class Options:
    """The option of every benchmark; one that repeats rounds has ``--rounds``."""

    out: Path | None = None
    """Where to write the figures; by default runs/NAME.json."""


@dataclass(frozen=True)
class Goal:
    """A figure with the most or the least that it may be; a ratio counts without its interval."""

    name: str
    value: float | Sequence[float]
    most: float | None = None
    least: float | None = None

    @property
    def met(self) -> bool:
        """Whether the figure is within the limit."""
        value = self.value if isinstance(self.value, int | float) else self.value[0]
        return (self.most is None or value <= self.most) and (self.least is None or value >= self.least)


@dataclass(frozen=True)
class Report:
    """The result of a benchmark: figures for the JSON file, tables by title for the reader, and goals."""

    figures: dict[str, Any]
    tables: Mapping[str, Rows]
    goals: Sequence[Goal] = field(default_factory=list)


@dataclass(frozen=True)
class Server:
    """A server's process, and its URL without a path."""

    url: str
    process: psutil.Process

    @property
    def port(self) -> int:
        """The port on the loopback interface."""
        return int(self.url.rsplit(":", 1)[1])

    def processor_s(self) -> float:
        """Processor seconds of the process and of those that it started, such as the one that writes its store."""
        return processor_s(self.process)

    def resident_bytes(self) -> int:
        """Resident bytes of the process and of those that it started."""
        return sum(each.memory_info().rss for each in (self.process, *self.process.children()))

    def resident_parts(self) -> dict[str, int]:
        """Resident bytes by part: allocations of the process and of its store's writer, and file and shared pages."""
        parts = dict.fromkeys(("edge", "writer", "files"), 0)
        for at, each in enumerate((self.process, *self.process.children())):
            status = Path(f"/proc/{each.pid}/status").read_text(encoding="ascii")
            for kind, kilobytes in re.findall(r"^Rss(Anon|File|Shmem):\s+(\d+) kB", status, re.MULTILINE):
                parts["files" if kind != "Anon" else "writer" if at else "edge"] += 1024 * int(kilobytes)
        return parts


OptionsT = TypeVar("OptionsT", bound=Options)
K = TypeVar("K")
T = TypeVar("T")


def run(options: type[OptionsT], measure: Callable[[OptionsT], Report]) -> bool:
    """Parse the command line, measure, print tables and goals, write the figures; returns whether goals are met."""
    args = tyro.cli(options, description=inspect.getmodule(measure).__doc__)
    report = measure(args)
    console = rich.get_console()
    for title, rows in report.tables.items():
        if rows:
            console.print(f"[bold]{title}", _table(rows))
    if report.goals:
        console.print(_goals(report.goals))
    out = args.out or Path("runs", f"{Path(sys.argv[0]).stem}.json")
    found = {"command": sys.argv, "machine": machine(), **report.figures}
    found["goals"] = [{**asdict(goal), "met": goal.met} for goal in report.goals]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=1, default=str) + "\n")
    console.print(f"Wrote {out}")
    return all(goal.met for goal in report.goals)


def machine() -> dict[str, Any]:
    """The facts of this machine that figures depend on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return {
        "cores": usable_cores(),
        "processor": next((line.split(": ")[1] for line in lines if line.startswith("model name")), platform.machine()),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def in_turn(
    variants: Mapping[K, Callable[[int], T]], rounds: int, warm_up: int = 0, alternate: bool = False
) -> dict[K, list[T]]:
    """The results of each variant, one a round: other work on the machine slows all variants of a round.

    Args:
        variants: functions of the number of the round.
        warm_up: rounds before, of negative numbers, that do not count.
        alternate: whether every other round has the reverse order.
    """
    found: dict[K, list[T]] = {name: [] for name in variants}
    for number in track(range(-warm_up, rounds), "measuring"):
        for name in reversed(list(variants)) if alternate and number % 2 else variants:
            result = variants[name](number)
            if number >= 0:
                found[name].append(result)
    return found


def shown(cell: Cell) -> str:
    """The cell as text, such as ``0.12 [0.10, 0.15]``; numbers from 100 on are whole."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int | float):
        return f"{cell:,.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
    value, low, high = map(shown, cell)
    return f"{value} [{low}, {high}]"


def processor_s(process: psutil.Process) -> float:
    """Seconds, user and system, of a process and of its descendants that still run."""
    used = 0.0
    for each in (process, *process.children(recursive=True)):
        try:
            times = each.cpu_times()
        except psutil.NoSuchProcess:
            continue
        used += times.user + times.system
    return used


def environment(settings: Mapping[str, object]) -> dict[str, str]:
    """This environment with these settings of an edge, by their names without ``AICVDS_``, and no others."""
    kept = {n: v for n, v in os.environ.items() if n == _INHERITED or not n.startswith(("AICVDS_", "OTEL_"))}
    return kept | {f"AICVDS_{name}": str(value) for name, value in settings.items()}


@contextmanager
def running(
    command: Sequence[str | Path],
    url: str,
    health: str,
    env: Mapping[str, str] | None = None,
    folder: Path = ROOT,
    ready: Callable[[httpx.Response], bool] = lambda _: True,
) -> Iterator[Server]:
    """Within the context, run a server as a process.

    Args:
        health: path that answers 200, with the content ``ready``, once the server can be measured.
        env: its environment; None: this process's.
        folder: where it runs.

    Raises:
        SystemExit: it ended, or was not ready after five minutes; the text has the end of its output.
    """
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, env=env, cwd=folder, stdout=output, stderr=subprocess.STDOUT)
        try:
            ends = time.monotonic() + START_S
            while not _answers(url + health, ready):
                if process.poll() is not None or time.monotonic() > ends:
                    output.seek(0)
                    raise SystemExit(f"{' '.join(map(str, command))} did not start:\n{output.read()[-2000:].decode()}")
                time.sleep(0.1)
            yield Server(url, psutil.Process(process.pid))
        finally:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def edge(
    settings: Mapping[str, object],
    checkout: Path | None = None,
    serve: Sequence[str] = ("shared.kit.command_line", "serve"),
    variables: Mapping[str, str] | None = None,
) -> Iterator[Server]:
    """Within the context, run an edge whose LLM, if it has one, is ready.

    Args:
        settings: by their names without ``AICVDS_``. ``STORE`` is by default a SQLite file of its own.
        checkout: another checkout of this repository, with its virtual environment in ``.venv``; None: this one.
        serve: the module that serves, and its first arguments.
        variables: more of its environment.
    """
    python = str(checkout.absolute() / ".venv/bin/python") if checkout else sys.executable
    port = str(usable_port(0))
    named = "LLM_URL" in settings
    with tempfile.TemporaryDirectory() as folder:
        settings = {"STORE": f"{folder}/missions.db", "LOG_LEVEL": "warning", **settings}
        with running(
            [python, "-m", *serve, "--host", HOST, "--port", port],
            f"http://{HOST}:{port}",
            "/readyz",
            environment(settings) | dict(variables or {}),
            checkout or ROOT,
            # Modes value and policy ask no LLM: theirs is off.
            lambda answer: answer.json()["llm"] in ("ready", "off") if named else answer.json()["llm"] != "loading",
        ) as server:
            yield server


@contextmanager
def instant_llm() -> Iterator[Server]:
    """Within the context, run an LLM that answers at once; an edge's ``LLM_URL`` is its URL and ``/v1``."""
    port = usable_port(0)
    command = [sys.executable, "-m", "benchmarks.instant_llm", str(port)]
    with running(command, f"http://{HOST}:{port}", "/v1/models") as server:
        yield server


def _answers(health: str, ready: Callable[[httpx.Response], bool]) -> bool:
    try:
        answer = httpx.get(health, timeout=5, trust_env=False)
    except httpx.HTTPError:
        return False
    return answer.status_code == 200 and ready(answer)


def _table(rows: Rows) -> Table:
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    table = Table("", *columns)
    for name, row in rows.items():
        table.add_row(name, *(shown(row.get(column, "")) for column in columns))
    return table


def _goals(goals: Sequence[Goal]) -> Table:
    table = Table("goal", "measured", "limit", "")
    for goal in goals:
        limit = f"at most {shown(goal.most)}" if goal.most is not None else f"at least {shown(goal.least or 0.0)}"
        table.add_row(goal.name, shown(goal.value), limit, "met" if goal.met else "[bold red]missed")
    return table
