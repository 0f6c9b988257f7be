from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from rich.console import Console

from shared.client.errors import EdgeError
from simulator.commands.running import command_main
from simulator.errors import UsageError


@dataclass(frozen=True)
class Fly:
    """Fly somewhere."""

    steps: int = 30
    """Waypoints."""


def flown(argv: list[str], run: Callable[[Fly], int]) -> int:
    return command_main(Fly, "aicvds fly", argv, lambda options, console: run(options))


def raising(error: BaseException) -> Callable[[Fly], int]:
    def run(options: Fly) -> int:
        raise error

    return run


def test_a_command_gets_its_options_and_a_console_and_its_exit_code_is_returned() -> None:
    def run(options: Fly, console: Console) -> int:
        assert isinstance(console, Console)
        return options.steps

    assert command_main(Fly, "aicvds fly", ["--steps", "7"], run) == 7


def test_help_is_printed_and_nothing_flown(capsys: pytest.CaptureFixture[str]) -> None:
    assert flown(["--help"], raising(AssertionError())) == 0
    assert "aicvds fly" in capsys.readouterr().out


def test_an_option_that_cannot_be_read_is_bad_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert flown(["--steps", "many"], raising(AssertionError())) == 2
    assert "--steps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (UsageError("--steps 0: give more"), 2, "--steps 0: give more"),
        (EdgeError("no edge answers"), 1, "no edge answers"),
        (PermissionError(13, "Permission denied", "runs"), 2, "Permission denied: runs"),
        (OSError("disk"), 2, "disk"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_is_one_line_on_stderr_and_an_exit_code(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert flown([], raising(error)) == code
    assert capsys.readouterr().err == f"aicvds fly: {line}\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_an_end_from_outside_is_like_ctrl_c_and_its_handler_is_restored(number: signal.Signals) -> None:
    def run(options: Fly) -> int:
        os.kill(os.getpid(), number)
        signal.pause()
        return 0

    # Under nohup the tests' own process ignores SIGHUP.
    with handled(number, signal.SIG_DFL):
        assert flown([], run) == 130
        assert signal.getsignal(number) == signal.SIG_DFL


def test_under_nohup_a_closed_terminal_ends_nothing() -> None:
    def run(options: Fly) -> int:
        os.kill(os.getpid(), signal.SIGHUP)
        return 0

    with handled(signal.SIGHUP, signal.SIG_IGN):
        assert flown([], run) == 0
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


@contextmanager
def handled(number: signal.Signals, handler: signal.Handlers) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)
