"""A fleet that keeps asking an edge, and what it was answered."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import httpx
import psutil

UAVS = 3
Report = Callable[..., dict[str, Any]]


@dataclass
class Asked:
    """Of some decisions: how late each came, milliseconds past its deadline (negative: in time), and why it was so."""

    late_ms: list[float] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)

    @property
    def worst_ms(self) -> float:
        """The latest."""
        return max(self.late_ms)

    def within(self, slack_ms: float) -> float:
        """The share that came no later than so many milliseconds past its deadline."""
        return sum(late <= slack_ms for late in self.late_ms) / len(self.late_ms)

    def reported(self) -> str:
        """The reasons, the most frequent first."""
        return ", ".join(f"{reason} {count}" for reason, count in self.reasons.most_common())


def ask(url: str, report: Report, count: int, deadline_ms: int, *, first_step: int = 0) -> Asked:
    """So many decisions for three UAVs at once, each with a connection of its own; raises on anything but a 200."""
    asked = Asked()

    def fly(uav: int) -> list[tuple[float, str]]:
        answers = []
        with httpx.Client(base_url=url, timeout=60) as client:
            for turn in range(uav, count, UAVS):
                step = first_step + turn // UAVS
                body = report(step=step, uav_id=uav, deadline_ms=deadline_ms, mission_id=f"faults-{uav}")
                began = time.perf_counter()
                answer = client.post("/decide", json=body)
                late = (time.perf_counter() - began) * 1e3 - deadline_ms
                answer.raise_for_status()
                answers.append((late, answer.json()["reason"] or "none"))
        return answers

    with ThreadPoolExecutor(UAVS) as pool:
        for answers in pool.map(fly, range(UAVS)):
            for late, reason in answers:
                asked.late_ms.append(late)
                asked.reasons[reason] += 1
    return asked


def resident_mb(pid: int) -> float:
    """Memory of a process, megabytes."""
    return float(psutil.Process(pid).memory_info().rss) / 1e6
