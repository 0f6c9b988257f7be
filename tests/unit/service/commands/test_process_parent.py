"""The parent of several processes, with children that do nothing but end."""

from __future__ import annotations

import subprocess
import sys

from tests.support.waiting import PATIENCE_S

# Each child is this program after the fork: it ends as the test says.
_PROGRAM = """
import os, signal, socket, sys
from service.commands import process_parent
from service.config.settings import Settings
process_parent._FIRST_PAUSE_S = 0.001
with socket.create_server(("127.0.0.1", 0)) as listener:
    settings = Settings(store="none", processes=2, log_format=sys.argv[2])
    member = process_parent.Parent(settings, listener).run()
if isinstance(member, int):
    sys.exit(member)
{ends}
"""


def _parent(ends: str, log_format: str = "text") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _PROGRAM.format(ends=ends), "", log_format]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_processes_that_end_again_and_again_end_the_edge() -> None:
    ended = _parent("os._exit(3 if member.slot else signal.pause())")
    assert ended.returncode == 1
    lines = ended.stderr.splitlines()
    assert lines[:7] == ["aicvds serve: process 1 has ended with exit code 3: another begins"] * 7
    assert lines[7] == "aicvds serve: process 1 has ended with exit code 3, 8 times in a row: the edge ends"


def test_settings_that_cannot_work_end_the_edge_at_once() -> None:
    ended = _parent("os._exit(2 if member.slot else signal.pause())")
    assert (ended.returncode, ended.stderr) == (2, "")


def test_only_the_first_process_of_a_place_begins_with_the_others() -> None:
    """A process in place of another one knows that it is; the parent ends with SIGTERM's code."""
    ends = """
if member.slot == 0:
    signal.pause()
if member.replaces:
    os.kill(os.getppid(), signal.SIGTERM)
    signal.pause()
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = _parent(ends, "json")
    assert ended.returncode == 0
    assert '"event": "process 1 has ended by signal 9: another begins", "level": "warning"' in ended.stderr
