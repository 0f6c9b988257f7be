"""The processor time that a process and those it started have used."""

from __future__ import annotations

import psutil


def processor_s(process: int) -> float:
    """Seconds, user and system, of a process and of its descendants that still run."""
    first = psutil.Process(process)
    used = 0.0
    for each in (first, *first.children(recursive=True)):
        try:
            times = each.cpu_times()
        except psutil.NoSuchProcess:
            continue
        used += times.user + times.system
    return used
