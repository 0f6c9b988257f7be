"""Running a command: parsing its command line, and turning its errors into messages and exit codes."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

import tyro
from rich.console import Console

from shared.client.errors import EdgeError, EdgeRefused, EdgeUnreachable
from simulator.errors import INTERRUPTED, RunFailed, UsageError

Options = TypeVar("Options")


def command_main(options: type[Options], prog: str, argv: list[str], run: Callable[[Options, Console], int]) -> int:
    """Run one command from its command line; returns the exit code.

    Args:
        options: the dataclass whose fields are the command's options and whose docstring is its ``--help``.
        prog: the command as people type it, such as ``aicvds simulate``.
        argv: the arguments after it.
        run: the command itself; returns its exit code, and its errors are printed as one line on stderr.
            SIGTERM and SIGHUP act like Ctrl-C.
    """
    try:
        chosen = tyro.cli(options, prog=prog, args=argv)
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 2
    try:
        with ends_interrupt():
            return run(chosen, Console())
    except (UsageError, EdgeError, RunFailed) as error:
        print(f"{prog}: {error}{_remedy(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except OSError as error:
        print(f"{prog}: {error.strerror or error}{f': {error.filename}' if error.filename else ''}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return INTERRUPTED


def _remedy(error: Exception) -> str:
    """What to type next, after a semicolon; empty where that is unknown."""
    if isinstance(error, EdgeUnreachable):
        return "; start an edge with `aicvds serve`, or correct --edge"
    if isinstance(error, EdgeRefused) and error.status == 401:
        return "; put a key into AICVDS_API_KEY (`aicvds keys add` makes one for the edge)"
    if isinstance(error, EdgeRefused) and error.status == 403:
        return "; AICVDS_API_KEY needs a key with that scope (`aicvds keys add --scopes decide admin`)"
    return ""


_TERMINALS = [each for each in (1, 2) if os.isatty(each)]


def leave_terminal(signum: int) -> None:
    """After SIGHUP a line written to the terminal would be an error, and end what writes the result."""
    for each in _TERMINALS if signum == getattr(signal, "SIGHUP", None) else ():
        os.dup2(os.open(os.devnull, os.O_WRONLY), each)


@contextmanager
def ends_interrupt() -> Iterator[None]:
    """Within the context, SIGTERM and SIGHUP raise KeyboardInterrupt: they leave a result as Ctrl-C does.

    A signal that is ignored, as SIGHUP is under nohup, stays ignored.
    """

    def interrupt(signum: int, frame: FrameType | None) -> None:
        leave_terminal(signum)
        raise KeyboardInterrupt

    # Windows has no SIGHUP.
    numbers = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
    before = {each: signal.signal(each, interrupt) for each in numbers if signal.getsignal(each) != signal.SIG_IGN}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
