from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from rich.console import Console

from simulator.cli.options import check_between, check_deadline, check_seed, check_wait, checked_edge
from simulator.cli.running import command_main
from simulator.errors import EdgeError, UsageError


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


def test_sigterm_ends_a_command_as_ctrl_c_does_and_means_what_it_did_before_afterwards() -> None:
    def run(options: Fly) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
        return 0

    before = signal.getsignal(signal.SIGTERM)
    assert flown([], run) == 130
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("check", "told"),
    [
        (lambda: check_seed(2**32), "--seed 4294967296 is not between 0 and 4294967295"),
        (lambda: check_seed(-1), "--seed -1 is not between 0 and 4294967295"),
        (lambda: check_wait(90_000.5), "--wait-s 90000.5 is not between 0 and 86400"),
        (lambda: check_wait(float("nan")), "--wait-s nan is not between 0 and 86400"),
        (lambda: check_deadline(9), "--deadline-ms 9 is not between 10 and 60000"),
        (lambda: check_between("--time-limit-s", 0.0, 0.1, 86_400), "--time-limit-s 0 is not between 0.1 and 86400"),
        (lambda: checked_edge(None), "--edge is missing: give the edge's address"),
        (lambda: checked_edge("ftp://edge"), "--edge: "),
    ],
)
def test_a_value_out_of_bounds_is_told_with_its_bounds(check: Callable[[], object], told: str) -> None:
    with pytest.raises(UsageError) as error:
        check()
    assert str(error.value).startswith(told)


def test_values_on_their_bounds_are_taken() -> None:
    check_seed(0)
    check_seed(2**32 - 1)
    check_wait(86_400)
    check_deadline(None)
    check_deadline(10)
    assert checked_edge("http://127.0.0.1:8000").startswith("http://127.0.0.1:8000")
