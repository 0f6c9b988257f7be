"""An edge in a process on this machine."""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from shared.client.errors import EdgeError
from shared.wire.schemas import Mode
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out

STOP_S = 10.0
TAIL_LINES = 15
HOST = "127.0.0.1"
EDGE_LOG = "edge.log"


class EdgeDied(EdgeError):
    """The edge's process ended unexpectedly; the text has the end of its log."""


@contextmanager
def edge_process(
    port: int, log: Path, environment: Mapping[str, str] | None = None, options: Sequence[str] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """Within the context, run an edge on the loopback's ``port`` with its output in ``log``.

    ``environment`` has its settings; ``None`` inherits this process's environment. ``options`` are of ``aicvds serve``.
    """
    command = [sys.executable, "-m", "shared.kit.command_line", "serve", "--host", HOST, "--port", str(port), *options]
    with naming_out(log.parent):
        output = log.open("wb")
    with output:
        # A separate session keeps Ctrl-C from the edge: the flight handles it, and still needs the edge to land.
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


@contextmanager
def edge_in_folder(
    out: Path, console: Console, mode: Mode | None = None, port: int = 0
) -> Iterator[tuple[str, Callable[[], None]]]:
    """Within the context, run an edge whose log and store are in ``out``.

    Args:
        out: an existing folder.
        mode: of missions without one of their own; None: that of this process's environment.
        port: on the loopback; 0 picks a free one.

    Yields:
        The edge's URL, and a function that raises :class:`EdgeDied` if the edge has ended.

    Raises:
        UsageError: the port is in use, or the folder cannot be written.
    """
    port, log = usable_port(port), out / EDGE_LOG
    # A store of its own, apart from that of another edge on this machine.
    environment = {**os.environ, "AICVDS_STORE": str(out.resolve() / "missions.db")}
    environment |= {} if mode is None else {"AICVDS_MODE": mode}
    with edge_process(port, log, environment) as process:
        console.print(
            f"Started an edge on port {port}; its log is {log}", markup=False, highlight=False, soft_wrap=True
        )
        yield f"http://{HOST}:{port}", lambda: check_alive(process, log)


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
    """Raises :class:`EdgeDied` with the end of the log if the edge's process has ended."""
    code = process.poll()
    if code is not None:
        tail = log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL_LINES:]
        raise EdgeDied("\n".join([f"the edge ended with code {code}; the end of {log}:", *tail]))


def usable_port(port: int) -> int:
    """A free port of the loopback: ``port``, or any for 0; raises ``UsageError`` if it is in use."""
    # With the port in use, the edge would die and the mission would ask the other server.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise UsageError(f"--port {port}: {error.strerror}; choose another, or 0 for a free one") from None
        return int(probe.getsockname()[1])
