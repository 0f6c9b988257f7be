"""The cores that this process may use."""

import os
from pathlib import Path


def usable_cores(cpu_max: Path = Path("/sys/fs/cgroup/cpu.max")) -> int:
    """Number of cores that this process may use, by affinity and by quota: in a container fewer than the machine has.

    Args:
        cpu_max: file of cgroup v2's quota: ``max 100000``, or the allowed microseconds and the period.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = cpu_max.read_text().split()
        return max(1, min(cores, int(quota) // int(period)))
    except (OSError, ValueError):
        return cores
