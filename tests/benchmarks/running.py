"""Runs a benchmark or a study as its docstring says, as a process of its own."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.support.places import ROOT


def figures(module: str, *options: str, out: Path, codes: tuple[int, ...] = (0,)) -> Any:
    """What it wrote; it ends with one of the codes."""
    run(module, *options, out=out, codes=codes)
    return json.loads(out.read_text())


def run(module: str, *options: str, out: Path, codes: tuple[int, ...] = (0,)) -> None:
    """Let it write there; it ends with one of the codes."""
    command = [sys.executable, "-m", module, *options, "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode in codes, done.stdout + done.stderr
