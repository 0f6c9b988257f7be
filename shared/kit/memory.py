"""Memory that this process has and does not need, given back to Linux; elsewhere nothing happens."""

import ctypes
import mmap
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

# Zeros are looked for in blocks of so many bytes.
_BLOCK, _ZEROS = 2**20, bytes(2**20)


def release_library(name: str) -> None:
    """Give back a loaded library's pages that no process has written to: Linux reads them again when needed."""
    with suppress(OSError, AttributeError):
        for first, end, entry in _mappings():
            if name in entry and re.search(r"Anonymous: +0 kB(?s:.*)\nSwap: +0 kB", entry):
                _give_back(first, end)


def release_zeros(least: int) -> None:
    """Give back zeros of which at least so many bytes follow each other: Linux makes them again when needed.

    No other thread may write to such memory or unmap it meanwhile. Its first and last megabyte stay, because the zeros
    at its ends may be others', and each megabyte is looked at again just before it is given back.
    """
    with suppress(OSError, AttributeError), Path("/proc/self/mem").open("rb", buffering=0) as memory:
        for first, end, entry in _mappings():
            if end - first < least or "rw-p 00000000 00:00 0" not in entry or "[heap]" in entry:
                continue
            blocks = range(first, end - _BLOCK + 1, _BLOCK)
            # Reading through the file fails where another thread has unmapped memory.
            zero = "".join("01"[os.pread(memory.fileno(), _BLOCK, block) == _ZEROS] for block in blocks)
            for run in re.finditer(f"1{{{max(3, least // _BLOCK)},}}", zero):
                for block in blocks[run.start() + 1 : run.end() - 1]:
                    if ctypes.string_at(block, _BLOCK) == _ZEROS:
                        _give_back(block, block + _BLOCK)


def _mappings() -> Iterator[tuple[int, int, str]]:
    """The first address of each mapping, the one after it, and its entry in ``smaps``."""
    for entry in re.split(r"\n(?=[0-9a-f]+-)", Path("/proc/self/smaps").read_text(encoding="utf-8")):
        first, end = (int(address, 16) for address in entry.split()[0].split("-"))
        yield first, end, entry


def _give_back(first: int, end: int) -> None:
    # PyDLL keeps the interpreter's lock.
    ctypes.PyDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), mmap.MADV_DONTNEED)
