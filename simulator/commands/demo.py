"""``aicvds demo``: an edge, its LLM and a whole mission on this machine, in one command."""

import shlex
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, arg

from simulator.commands.options import WorldOptions, check_between, check_wait, site_of
from simulator.commands.running import command_main
from simulator.flying.job import BOUND_S, Job, new_mission_id
from simulator.flying.local_edge import edge_in_folder
from simulator.flying.run import run_mission
from simulator.records.run_folder import REPORT, fresh_folder, refuse_old_result


@dataclass(frozen=True)
class Demo(WorldOptions):
    """Start an edge on this machine, fly a mission against it, and compare with EOF and WQCS.

    The edge loads its LLM (the embedded one, or that of the AICVDS_LLM_* variables), decides for three UAVs at thirty
    waypoints each, then in the same world without the LLM, and stops. Written to --out, over those of an
    earlier demo: report.html (open it in a browser), summary.json, figures, decisions.jsonl, requests.jsonl, edge.log.

    Try it:  aicvds demo --out runs/demo

    Exit code: 0 flown, 1 the edge did not start or answer, 2 bad use, 130 interrupted.
    """

    out: Path = Path("runs/demo")
    """Folder to write to, made if missing."""
    port: int = 0
    """Port of the edge on 127.0.0.1, 0 to 65535; 0 picks a free one."""
    wait_s: float = 300.0
    """Seconds that the edge may take to start and to load its LLM."""
    bound: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = True
    """Leave out the search, of at most 10 s after the flight, for the fewest packets that any fleet could have lost. It
    needs the extra `bound`."""


def main(argv: list[str]) -> int:
    """Run ``aicvds demo``; returns the exit code."""
    command = shlex.join(["aicvds", "demo", *argv])
    return command_main(Demo, "aicvds demo", argv, lambda options, console: demo(options, command, console))


def demo(options: Demo, command: str, console: Console) -> int:
    """Start the edge, fly, stop the edge; returns the exit code.

    Raises:
        UsageError: the options are unusable, or the folder cannot be written.
        EdgeError: the edge died at start, or never became ready.
    """
    site = site_of(options)
    check_wait(options.wait_s)
    check_between("--port", options.port, 0, 65_535)
    refuse_old_result(options.out, overwrite=True)
    fresh_folder(options.out)
    with edge_in_folder(options.out, console, port=options.port) as (edge, alive):
        job = Job(
            site=site,
            seed=options.seed,
            mission_id=new_mission_id(site.scenario, options.seed),
            out=options.out,
            command=command,
            edge=edge,
            wait_s=options.wait_s,
            bound_s=BOUND_S if options.bound and find_spec("ortools") is not None else 0.0,
            reference="policy",
        )
        code = run_mission(job, console, alive=alive)
    if code == 0:
        console.print(_next_steps(options.out), markup=False, highlight=False, soft_wrap=True)
    return code


def _next_steps(out: Path) -> str:
    """What to open and what to try after the demo."""
    steps = {
        "aicvds serve": "an edge that stays, with its page at http://127.0.0.1:8000/",
        "aicvds simulate --edge http://127.0.0.1:8000 --out runs/next": "a mission to watch on that page",
        f"aicvds compare {out} runs/next": "both side by side",
    }
    listed = "\n".join(f"  {command}\n      {what}" for command, what in steps.items())
    return f"\nOpen {out / REPORT} in a browser. Then try (in a clone: .venv/bin/aicvds):\n{listed}"
