"""What the simulator's commands have in common: reading the command line, checking it, and telling of errors."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

import tyro
from rich.console import Console

from simulator.client import EdgeError, edge_url
from simulator.record import BadUse

INTERRUPTED = 130

Options = TypeVar("Options")


def command_main(options: type[Options], prog: str, argv: list[str], run: Callable[[Options, Console], int]) -> int:
    """Run one command from its command line; returns the exit code.

    Args:
        options: the dataclass whose fields are the command's options and whose docstring is its ``--help``.
        prog: the command as people type it, such as ``aicvds simulate``.
        argv: the words after it.
        run: the command itself; returns its exit code, and may raise what :func:`reporting` tells of.
    """
    try:
        chosen = tyro.cli(options, prog=prog, args=argv)
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 2
    return reporting(prog, lambda console: run(chosen, console))


def reporting(prog: str, run: Callable[[Console], int]) -> int:
    """Run a command with its errors as one line on stderr and an exit code; SIGTERM ends it as Ctrl-C does."""
    try:
        with sigterm_interrupts():
            return run(Console())
    except BadUse as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    except EdgeError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"{prog}: {error.strerror or error}{f': {error.filename}' if error.filename else ''}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Within, SIGTERM raises KeyboardInterrupt, so that `docker stop` leaves a result as Ctrl-C does."""

    def interrupt(signum: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def check_between(option: str, value: float, least: float, most: float) -> None:
    """Raises ``BadUse`` for an option such as ``--port`` whose value is not from ``least`` to ``most``."""
    if not least <= value <= most:
        told = f"{value:g}" if isinstance(value, float) else value
        raise BadUse(f"{option} {told} is not between {least} and {most}")


def check_seed(seed: int) -> None:
    """Raises ``BadUse`` for a ``--seed`` that is no world's."""
    check_between("--seed", seed, 0, 2**32 - 1)


def check_wait(wait_s: float) -> None:
    """Raises ``BadUse`` for a ``--wait-s`` of less than nothing or more than a day."""
    check_between("--wait-s", wait_s, 0, 86_400)


def check_deadline(deadline_ms: int | None) -> None:
    """Raises ``BadUse`` for a ``--deadline-ms`` that no edge takes; ``None`` is the edge's own."""
    if deadline_ms is not None:
        check_between("--deadline-ms", deadline_ms, 10, 60_000)


def checked_edge(edge: str | None) -> str:
    """The address that ``--edge`` gives; raises ``BadUse`` where it is missing or none."""
    if edge is None:
        raise BadUse("--edge is missing: give the edge's address, such as --edge http://127.0.0.1:8000")
    try:
        return edge_url(edge)
    except ValueError as error:
        raise BadUse(f"--edge: {error}") from None
