"""The path of one `POST /decide` through the code: its files, its functions, and its changes of file.

    python -m lab.benchmarks.decision_path
    python -m lab.benchmarks.decision_path --modes guided --list

It runs `aicvds serve` in a process of its own for each mode and round, in the main thread, with a SQLite store, a
planner, and an LLM that answers at once from a thread of the same process. After four decisions it counts two requests
of UAV 0 with the README's four sensors, first without an outcome, then with an earlier decision's outcome.

`sys.setprofile` counts, from the request to the last byte of the answer, every `call` event of a Python function in the
packages `service` and `shared`; a coroutine that resumes is one more call. A file counts once it is entered. A function
is known by its file and qualified name; lambdas and comprehensions do not count. A change of file is a call on the
event loop's thread in another file than the call before it; a return to a caller is none. The other threads (plan
search, rollout evaluator) count apart, and the process that writes SQLite does not count. Learning from the outcome is
part of the path, and so are the limits on headers, the startup gate and the client of the LLM. The number of a
coroutine's resumptions depends a little on timing, so each mode is measured several times, and the result is the
median. It prints a table and writes JSON.
A busy machine adds 5 changes where the store's timer begins a commit in the midst of the decision, and 2 where a
request's body comes after its head.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import httpx
import tyro
import uvicorn.protocols.http.httptools_impl as uvicorn_http
from rich.console import Console
from rich.table import Table

from lab.experiments.stand_ins import answering
from shared.client.edge_client import EdgeClient
from simulator.flying.local_edge import HOST, usable_port

PACKAGES = ("service", "shared")
# The method that writes each part of an answer to the connection.
_SEND = uvicorn_http.RequestResponseCycle.send
# The first argument of a counting process; its mode follows.
COUNTED = "counted"
SENSORS: dict[str, list[Any]] = {
    "id": [0, 1, 2, 3],
    "x": [420, 650, 300, 900],
    "y": [380, 520, 700, 100],
    "queue": [52, 17, 33, None],
    "battery": [49, 50, 47.5, None],
    "channel_gain": [-83.1, -96.0, -109.2, None],
}


@dataclass(frozen=True)
class DecisionPath:
    """Count the calls of one decision."""

    modes: tuple[str, ...] = ("guided", "llm")
    """Modes of the missions."""
    rounds: int = 3
    """Processes for each mode."""
    show: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(name="list")] = False
    """Show the event loop's calls of the last round in order, grouped by file."""
    out: Path = Path("runs/decision_path.json")
    """Where to write."""


@dataclass
class Calls:
    """The calls while ``recording``, as (file, function): the event loop's in order, and those of other threads."""

    loop: list[tuple[str, str]] = field(default_factory=list)
    other_threads: list[tuple[str, str]] = field(default_factory=list)
    recording: bool = False

    def __post_init__(self) -> None:
        self._roots = {}
        for package in PACKAGES:
            spec = find_spec(package)
            assert spec is not None and spec.submodule_search_locations is not None
            self._roots[package] = f"{Path(spec.submodule_search_locations[0]).resolve()}/"
        self._main = threading.main_thread().ident

    def on_event(self, frame: FrameType, event: str, _: object) -> None:
        """The profile function of ``sys.setprofile``."""
        if not self.recording:
            return
        if event == "return" and frame.f_code is _SEND.__code__:
            # The path ends with the last byte of the answer.
            self.recording = not frame.f_locals["self"].response_complete
        if event != "call":
            return
        name = frame.f_code.co_filename
        for package, root in self._roots.items():
            if name.startswith(root):
                calls = self.loop if threading.get_ident() == self._main else self.other_threads
                calls.append((f"{package}/{name.removeprefix(root)}", frame.f_code.co_qualname))


def counts(calls: Calls) -> dict[str, Any]:
    """The counts of the calls."""
    files = {file for file, _ in calls.loop}
    named = {(file, name) for file, name in calls.loop if not name.endswith(">")}
    return {
        "files": len(files),
        **{package: sum(file.startswith(f"{package}/") for file in files) for package in PACKAGES},
        "functions": len(named),
        "calls": len(calls.loop),
        "changes of file": sum(one[0] != other[0] for one, other in zip(calls.loop, calls.loop[1:], strict=False)),
        "files beside": len({file for file, _ in calls.other_threads}),
        "functions beside": len({(file, name) for file, name in calls.other_threads if not name.endswith(">")}),
    }


def first(body: dict[str, Any]) -> str:
    """The first answer that the grammar of a request to the LLM allows."""
    return " ".join(re.findall(r'"(\w+)"(?: \| "\w+")*', body.get("grammar", ""))) or "0 0"


def count(mode: str) -> None:
    """Serve in this thread, ask from another; prints the calls as JSON and ends the process."""
    port, folder = usable_port(0), tempfile.mkdtemp()
    for name in [name for name in os.environ if name.startswith("AICVDS_")]:
        del os.environ[name]
    settings = {"MODE": mode, "STORE": f"{folder}/m.db", "PLANNER_MS": "60000", "DEADLINE_MS": "60000"}
    settings |= {"LOG_LEVEL": "warning"}
    os.environ |= {f"AICVDS_{name}": value for name, value in settings.items()}
    calls = Calls()
    threading.Thread(target=_ask, args=(port, calls), daemon=True).start()
    (serve,) = entry_points(group="aicvds.commands", name="serve")
    main = serve.load()
    with answering(first) as os.environ["AICVDS_LLM_URL"]:
        threading.setprofile(calls.on_event)
        sys.setprofile(calls.on_event)
        main(["--port", str(port)])


def _ask(port: int, calls: Calls) -> None:
    code = 1
    try:
        url = f"http://{HOST}:{port}"
        with EdgeClient(url) as waiting:
            waiting.wait_ready(300)
        with httpx.Client(base_url=url, timeout=90) as client:
            for step, uav in ((0, 0), (0, 1), (0, 2), (1, 0)):
                answer = _decide(client, step, uav, None)
            body = {"decision_id": answer["decision_id"], "cost": 0.2, "failed": False}
            counted = []
            for step, outcome in ((2, None), (3, body)):
                # Wait until the work after the last answer has ended.
                time.sleep(0.5)
                calls.loop, calls.other_threads, calls.recording = [], [], True
                answer = _decide(client, step, 0, outcome)
                calls.recording = False
                assert answer["source"] in ("llm", "guided"), answer
                counted.append({"loop": calls.loop, "beside": calls.other_threads})
        print(json.dumps(counted), flush=True)
        code = 0
    finally:
        os._exit(code)


def _decide(client: httpx.Client, step: int, uav: int, outcome: dict[str, Any] | None) -> dict[str, Any]:
    last_seen = [None if queue is None else step for queue in SENSORS["queue"]]
    body: dict[str, Any] = {
        "step": step,
        "uav_id": uav,
        "position": [500, 450],
        "progress_m": 100.0 * step,
        "sensors": {**SENSORS, "last_seen": last_seen},
    }
    answer = client.post("/decide", json=body if outcome is None else {**body, "outcome": outcome})
    answer.raise_for_status()
    decision: dict[str, Any] = answer.json()
    return decision


def measured(mode: str, rounds: int) -> Iterator[list[Calls]]:
    """The calls of each round, each from a process of its own."""
    for _ in range(rounds):
        command = [sys.executable, "-m", "lab.benchmarks.decision_path", COUNTED, mode]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=300)
        counted = json.loads(done.stdout)
        yield [Calls([tuple(call) for call in one["loop"]], [tuple(call) for call in one["beside"]]) for one in counted]


def show_list(calls: Calls, console: Console) -> None:
    """Print the event loop's calls in order."""
    last = ""
    for file, name in calls.loop:
        if file != last:
            console.print(file, style="bold", highlight=False)
        console.print(f"  {name}", markup=False, highlight=False)
        last = file


def main(options: DecisionPath) -> None:
    """Measure, print, write."""
    console = Console()
    found: dict[str, dict[str, Any]] = {}
    table = Table("", title="One POST /decide")
    for mode in options.modes:
        rounds = list(measured(mode, options.rounds))
        for place, request in enumerate((mode, f"{mode}, outcome")):
            each = [counts(calls[place]) for calls in rounds]
            found[request] = {name: statistics.median_low(one[name] for one in each) for name in each[0]}
            found[request]["sequence"] = [f"{file}:{name}" for file, name in rounds[-1][place].loop]
            table.add_column(request)
            if options.show:
                show_list(rounds[-1][place], console)
    for name in [name for name in next(iter(found.values())) if name != "sequence"]:
        table.add_row(name, *(str(found[mode][name]) for mode in found))
    console.print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == [COUNTED]:
        count(sys.argv[2])
    else:
        main(tyro.cli(DecisionPath, description=__doc__))
