"""The commands as a user starts them: processes, ports, signals."""

from __future__ import annotations

import io
import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from lab import command_line as lab
from shared.kit import command_line as cli
from tests.support.places import ROOT
from tests.support.waiting import PATIENCE_S

AICVDS = Path(sys.executable).with_name("aicvds")


LAB = (sys.executable, "-m", "lab")


def run(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run one command of ``aicvds`` to its end."""
    return _run([str(AICVDS), *args], env)


def run_lab(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run one command of ``python -m lab`` to its end."""
    return _run([*LAB, *args], env)


def run_here(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """As :func:`run`, in this process: for commands that end before they start anything."""
    return _run_here(cli.main, args, env)


def run_lab_here(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """As :func:`run_lab`, in this process."""
    return _run_here(lab.main, args, env)


def _run(command: Sequence[str], env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=170, env={**os.environ, **env}, check=False
    )


def _run_here(main: Callable[[], int], args: Sequence[str], env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.dict(os.environ, env),
        patch.object(sys, "argv", ["a command", *args]),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            code = main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return subprocess.CompletedProcess(args, code, out.getvalue(), err.getvalue())


@contextmanager
def started(*args: str, **env: str) -> Iterator[subprocess.Popen[str]]:
    """A command in the background, killed at the end if it still runs."""
    # Under nohup the tests' own process ignores SIGHUP.
    command: list[str | Path] = ["env", "--default-signal=HUP", AICVDS, *args]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env={**os.environ, **env}
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)


def output_until(process: subprocess.Popen[str], pattern: str) -> re.Match[str]:
    """Read the command's output until a line matches."""
    assert process.stdout is not None
    seen, ends = "", time.monotonic() + PATIENCE_S
    while time.monotonic() < ends:
        if select.select([process.stdout], [], [], 0.2)[0]:
            chunk = os.read(process.stdout.fileno(), 65536).decode(errors="replace")
            if not chunk:
                break
            seen += chunk
            if match := re.search(pattern, seen):
                return match
    raise AssertionError(f"never saw {pattern!r} in:\n{seen}")


@contextmanager
def serving_edge(port: str = "0", **env: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """``aicvds serve``, by default on a free port and with a long deadline; yields its URL and process."""
    with started("serve", "--port", port, **{"AICVDS_DEADLINE_MS": "60000", **env}) as process:
        yield output_until(process, r"listening on (http://[\d.:]+)")[1], process
