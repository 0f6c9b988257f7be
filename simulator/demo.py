"""``aicvds demo``: an edge, its LLM and a whole mission on this machine, in one command."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from simulator.client import EdgeError
from simulator.commandline import check_between, check_seed, check_wait, command_main
from simulator.record import BadUse, fresh_folder, naming_out, refuse_old_result
from simulator.simulate import Job, conduct
from simulator.site import chosen_site

EDGE_LOG = "edge.log"
STOP_S = 10.0
TAIL_LINES = 15
HOST = "127.0.0.1"


@dataclass(frozen=True)
class Demo:
    """Start an edge on this machine, fly a mission against it, and compare with EOF and WQCS.

    The edge loads its LLM (the embedded one, or the one that the AICVDS_LLM_* variables name), decides for
    three UAVs at thirty waypoints each, and is stopped again. Written to --out: report.html (open it in a
    browser), summary.json, decisions.jsonl and edge.log. What an earlier demo left there is overwritten.

    Try it:  aicvds demo --out runs/demo

    Exit code: 0 flown, 1 the edge did not start or answer, 2 bad use, 130 interrupted.
    """

    out: Path = Path("runs/demo")
    """Folder to write to, made if missing."""
    seed: int = 0
    """Of the world, 0 to 4294967295; the same seed is the same world."""
    scenario: str | None = None
    """A ready-made world: paper (the default), pipeline, stress, dense or lossy_uplink; `aicvds simulate --help`
    says what they are."""
    world: Path | None = None
    """A folder with a world of your own, instead of --scenario; `aicvds simulate --help` says what is in it."""
    port: int = 0
    """Port of the edge on 127.0.0.1, 0 to 65535; 0 picks a free one."""
    wait_s: float = 300.0
    """Seconds that the edge may take to start and to load its LLM."""


class EdgeDied(EdgeError):
    """The edge's process ended by itself; the text has the end of its log."""


def main(argv: list[str]) -> int:
    """Run the demo that the command line describes; returns the exit code."""
    command = shlex.join(["aicvds", "demo", *argv])
    return command_main(Demo, "aicvds demo", argv, lambda options, console: demo(options, command, console))


def demo(options: Demo, command: str, console: Console) -> int:
    """Serve, fly, stop; returns the exit code.

    Raises:
        BadUse: the options make no demo, or the folder cannot be written.
        EdgeError: the edge died at start, or never became ready.
    """
    site = chosen_site(options.scenario, options.world)
    check_seed(options.seed)
    check_wait(options.wait_s)
    check_between("--port", options.port, 0, 65_535)
    refuse_old_result(options.out, overwrite=True)
    port = usable_port(options.port)
    fresh_folder(options.out)
    from simulator.mission import new_mission_id

    job = Job(
        site=site,
        seed=options.seed,
        mission_id=new_mission_id(site.scenario, options.seed),
        out=options.out,
        command=command,
        edge=f"http://{HOST}:{port}",
        wait_s=options.wait_s,
    )
    log = options.out / EDGE_LOG
    # Not the store of an edge that may run here already.
    environment = {**os.environ, "AICVDS_STORE": str(options.out.resolve() / "missions.db")}
    with edge_process(port, log, environment) as process:
        console.print(
            f"Started an edge on port {port}; its log is {log}", markup=False, highlight=False, soft_wrap=True
        )
        return conduct(job, console, alive=lambda: check_alive(process, log))


@contextmanager
def edge_process(
    port: int, log: Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """An edge on the loopback's ``port``, its output in ``log``; stopped on leaving, whatever the reason.

    ``environment`` has its settings; ``None``: this process's.
    """
    command = [sys.executable, "-m", "shared.cli", "serve", "--host", HOST, "--port", str(port)]
    with naming_out(log.parent):
        output = log.open("wb")
    with output:
        # A session of its own: Ctrl-C must reach the flight first, which still needs its edge to land.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
        )
        try:
            yield process
        finally:
            _stop(process)


def _stop(process: subprocess.Popen[bytes]) -> None:
    try:
        process.terminate()
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def check_alive(process: subprocess.Popen[bytes], log: Path) -> None:
    """Raises :class:`EdgeDied` with the end of its log once the edge has ended."""
    code = process.poll()
    if code is not None:
        tail = log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL_LINES:]
        raise EdgeDied("\n".join([f"the edge ended with code {code}; the end of {log}:", *tail]))


def usable_port(port: int) -> int:
    """A port of the loopback that is free: ``port``, or any for 0; raises ``BadUse`` if it is taken."""
    # Were the port taken, the edge would die and the mission fly against whatever listens there.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise BadUse(f"--port {port}: {error.strerror}; choose another, or 0 for a free one") from None
        return int(probe.getsockname()[1])
