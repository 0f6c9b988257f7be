from __future__ import annotations

import os
import signal
from collections.abc import Callable
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


def test_sigterm_ends_a_command_like_ctrl_c_and_its_handler_is_restored() -> None:
    def run(options: Fly) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
        return 0

    before = signal.getsignal(signal.SIGTERM)
    assert flown([], run) == 130
    assert signal.getsignal(signal.SIGTERM) is before
