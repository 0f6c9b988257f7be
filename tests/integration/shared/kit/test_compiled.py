"""Compiled functions are kept for later processes, also in a folder that nobody can write."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

MODULE = """
from shared.kit.compiled import compiled, inlined
from other import STEP

@inlined
def more(x):
    return x + STEP

@compiled
def next_one(x):
    return more(x)
"""
CALL = """
import json, sys
from numba.core.caching import _CacheLocator
def refuse(*_):
    raise OSError("read-only")
if sys.argv[1] == "read-only":
    _CacheLocator.ensure_cache_path = refuse
from counting import next_one
print(json.dumps([next_one(1), sum(next_one.stats.cache_hits.values())]))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A module with a compiled function, and one beside it."""
    (tmp_path / "counting.py").write_text(MODULE)
    (tmp_path / "other.py").write_text("STEP = 1\n")
    return tmp_path


def call(folder: Path, how: str = "writable") -> list[int]:
    """What the function returns in a new process, and how often it was loaded."""
    ran = subprocess.run([sys.executable, "-c", CALL, how], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    found: list[int] = json.loads(ran.stdout)
    return found


def test_a_function_is_compiled_once_and_again_after_a_change_of_its_folder(folder: Path) -> None:
    assert call(folder) == [2, 0]
    assert call(folder) == [2, 1]
    (folder / "other.py").write_text("STEP = 2\n")
    assert call(folder) == [3, 0]
    assert call(folder) == [3, 1]


def test_a_read_only_folder_has_what_was_compiled_before(folder: Path) -> None:
    assert call(folder) == [2, 0]
    assert call(folder, "read-only") == [2, 1]


def test_where_no_folder_can_be_written_it_is_compiled_all_the_same(folder: Path) -> None:
    assert call(folder, "read-only") == [2, 0]
    assert not list(folder.rglob("*.nbi"))
