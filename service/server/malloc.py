"""How the process's memory goes back to the system."""

from __future__ import annotations

import ctypes

# glibc's names for what mallopt sets (malloc.h).
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_BYTES = 128 * 1024


def hand_back_memory() -> None:
    """Have glibc's malloc keep little of what is freed; elsewhere nothing changes. Before the first thread starts.

    It gives every thread an arena of its own, and raises the size from which memory goes back at once to that of the
    largest block ever freed: the LLM's states, megabytes each. What threads freed then lay about in all arenas: after a
    quarter of an hour with 200 missions 117 MB, and more each minute; with one arena and fixed sizes 12 MB.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return
    for what, value in ((_ARENA_MAX, 1), (_MMAP_THRESHOLD, _BYTES), (_TRIM_THRESHOLD, _BYTES)):
        mallopt(what, value)
