"""Memory that the process gives back: less is resident, and all of it reads as before."""

import mmap
import re
from pathlib import Path

import numpy as np
import pytest

from shared.kit.memory import release_library, release_zeros

MB = 2**20
SIZE = 16 * MB


def resident_mb(memory: np.ndarray) -> float:
    """The resident part of the mapping that begins with an array or contains it."""
    at = memory.ctypes.data
    for entry in re.split(r"\n(?=[0-9a-f]+-)", Path("/proc/self/smaps").read_text(encoding="utf-8")):
        first, end = (int(address, 16) for address in entry.split()[0].split("-"))
        if first <= at < end:
            found = re.search(r"Rss: +(\d+) kB", entry)
            assert found is not None
            return int(found[1]) / 1024
    raise AssertionError("no mapping")


@pytest.fixture
def written() -> np.ndarray:
    """Anonymous memory of which every page was written to."""
    memory = np.frombuffer(mmap.mmap(-1, SIZE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), dtype=np.uint8)
    memory[:] = 1
    memory[:] = 0
    return memory


def test_written_zeros_take_no_memory_and_stay_zeros(written: np.ndarray) -> None:
    before = resident_mb(written)
    release_zeros(SIZE - 2 * MB)
    # The first and the last megabyte stay, and up to one more, where the blocks do not begin with the array.
    assert resident_mb(written) < before - 12
    assert not written.any()
    written[:] = 3
    assert (written == 3).all()


@pytest.mark.parametrize("at", [0, SIZE // 2, SIZE - 1])
def test_what_is_not_zero_stays(written: np.ndarray, at: int) -> None:
    written[at] = 7
    release_zeros(3 * MB)
    assert written[at] == 7 and np.count_nonzero(written) == 1


def test_fewer_zeros_stay(written: np.ndarray) -> None:
    before = resident_mb(written)
    written[:: 2 * MB] = 1
    release_zeros(3 * MB)
    assert resident_mb(written) == before


def test_a_library_that_was_given_back_still_works() -> None:
    table = np.linspace(0.0, 1.0, 5000)
    before = np.linalg.norm(table), np.sort(table)[:3].tolist()
    release_library("_multiarray_umath")
    release_library("no such library")
    assert (np.linalg.norm(table), np.sort(table)[:3].tolist()) == before
