"""A long flight of 200 missions against one edge, with hostile clients: do its resources stay bounded?

    python -m benchmarks.soak --minutes 60

It starts an edge with its embedded LLM and a store, and flies 198 missions of mode ``value`` and 2 of mode ``guided``
at the same time, with outcomes, request keys, retries and sometimes a deleted mission. A mission's memory is bounded,
and full after some 300 outcomes. The resident memory is a peak, and rises less and less often after that. So the edge
first flies at full speed, for 900 outcomes of every mission (300 of those that ask the LLM). Then it flies at the pace
of the paper's world, a step of every mission in 10 s, and the measurement begins after 4 minutes of that pace;
``--pace-s 0`` measures at full speed. The results are the slope of the resident memory, by least squares over medians
of 20 parts (an LLM's call takes 8 MB and returns them), with its 95% interval, the count of tasks, connections and open
files before and after the hostile clients, lost outcomes, late and unstored decisions, and the sources of mode
``guided``'s decisions. It prints them, and writes the same as JSON. The hostile clients run in the settling time and in
the measurement: they do not read, read or write a byte a second, or vanish. ``--guided 0`` shows the edge without the
LLM's own memory.
"""

from __future__ import annotations

import http.client
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
from rich.progress import Progress
from scipy import stats

from benchmarks.harness import Goal, Options, Report, Server, edge, run
from benchmarks.hostile_clients import hostile
from benchmarks.missions import Flown, Radio

SAMPLE_S = 2.0
WORKERS = 3
DELETED_ONE_IN = 2000


@dataclass(frozen=True)
class Soak(Options):
    """Fly 200 missions and watch the edge's memory."""

    minutes: float = 10.0
    """Minutes of the measurement, after the warm-up."""
    pace_s: float = 10.0
    """Seconds in which every mission flies a step during the measurement; 0: full speed."""
    guided: int = 2
    """Missions of mode guided, with the embedded LLM; 0 loads no LLM."""
    missions: int = 200
    """All missions."""
    warm: tuple[int, int] = (900, 300)
    """Outcomes of each mission before the measurement, in mode value and in mode guided."""
    hostile: int = 100
    """Hostile clients of each of the five kinds at a time; 0: none."""
    counted_s: float = 30.0
    """Seconds before and after the hostile clients in which tasks, connections and files are counted."""
    settle_s: float = 240.0
    """Seconds at the pace before the measurement, in which memory freed by the slower pace is used again."""


@dataclass
class Mission(Flown):
    """One fleet's progress in its flight, and its decisions by source."""

    mode: str = "value"
    sources: Counter[str] = field(default_factory=Counter)
    reported: int = 0
    """Acknowledged outcomes since the mission was made."""
    unstored: int = 0


@dataclass
class Sample:
    """The resources of the edge's process at one time."""

    at_s: float
    resident_mb: float
    parts_mb: dict[str, float]
    tasks: float
    connections: int
    files: int


class Worker(threading.Thread):
    """Flies its missions in turn, a fleet's step at a time."""

    def __init__(self, edge: Server, missions: list[Mission], seed: int) -> None:
        super().__init__(daemon=True)
        self._radio, self._missions, self._random = Radio(edge, seed), missions, random.Random(seed)
        self.stopped = False
        self.pace_s = 0.0
        self.error: str | None = None

    def run(self) -> None:
        try:
            while not self.stopped:
                began = time.monotonic()
                for flown, mission in enumerate(self._missions, 1):
                    self._step(mission)
                    due = began + self.pace_s * flown / len(self._missions)
                    while not self.stopped and (left := due - time.monotonic()) > 0:
                        time.sleep(min(left, 1.0))
        except (OSError, http.client.HTTPException, KeyError, SystemExit) as error:
            if not self.stopped:
                self.error = repr(error)

    def _step(self, mission: Mission) -> None:
        if self._random.randrange(DELETED_ONE_IN) == 0 and mission.step:
            self._radio.post(f"/missions/{mission.name}", {}, "DELETE")
            self._radio.create(mission.name, mission.mode)
            mission.outcomes.clear()
            mission.reported = 0
        reported = len(mission.outcomes)
        decisions = self._radio.step(mission, attempts=1 + (self._random.randrange(20) == 0))
        mission.reported += reported
        mission.unstored += sum(not decision["stored"] for decision in decisions)
        mission.sources.update(decision["source"] for decision in decisions)


def metric(edge: Server, name: str) -> float:
    """The current value of a metric without labels."""
    lines = httpx.get(f"{edge.url}/metrics", timeout=30).text.splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{name} "))


def sample(edge: Server, began: float) -> Sample:
    """The edge's current resources."""
    return Sample(
        at_s=time.monotonic() - began,
        resident_mb=edge.resident_bytes() / 1e6,
        parts_mb={name: part / 1e6 for name, part in edge.resident_parts().items()},
        tasks=metric(edge, "aicvds_tasks"),
        connections=len(edge.process.net_connections("tcp")),
        files=edge.process.num_fds(),
    )


def slope(samples: list[Sample]) -> tuple[float, float]:
    """Megabytes an hour of the resident memory, and half of its 95% interval, by least squares over 20 medians.

    Successive samples are similar, so the interval of all samples would be too narrow.
    """
    parts = np.array_split(np.array([[s.at_s / 3600, s.resident_mb] for s in samples]), min(20, len(samples)))
    hours, megabytes = np.array([np.median(part, axis=0) for part in parts]).T
    fit = stats.linregress(hours, megabytes)
    return float(fit.slope), float(stats.t.ppf(0.975, len(parts) - 2) * fit.stderr)


def measure(options: Soak) -> Report:
    """Fly; the goals of the report limit the growth."""
    missions = [Mission(f"soak{n}", mode="guided" if n < options.guided else "value") for n in range(options.missions)]
    with edge({"LOG_LEVEL": "error", **({} if options.guided else {"MODE": "value"})}) as server:
        samples, counts, ended, late = _fly(server, missions, options)
        statuses = [httpx.get(f"{server.url}/missions/{mission.name}", timeout=30).json() for mission in missions]
    lost = sum(mission.reported - status["feedback"] for mission, status in zip(missions, statuses, strict=True))
    grown, half = slope(samples)
    figures: dict[str, Any] = {
        "minutes": options.minutes,
        "missions": options.missions,
        "pace_s": options.pace_s,
        "decisions": sum(mission.sources.total() for mission in missions),
        "guided": dict(sum((mission.sources for mission in missions if mission.mode == "guided"), Counter[str]())),
        "hostile_connections_ended": dict(ended),
        "late": late,
        "lost": lost,
        "unstored": sum(mission.unstored for mission in missions),
        "resident_mb": [round(samples[0].resident_mb, 1), round(samples[-1].resident_mb, 1)],
        "resident_parts_mb": {
            name: [round(samples[at].parts_mb[name], 1) for at in (0, len(samples) // 2, -1)]
            for name in samples[0].parts_mb
        },
        "slope_mb_an_hour": [round(value, 2) for value in (grown, grown - half, grown + half)],
    }
    goals = [Goal("memory, MB an hour, lower bound", grown - half, most=1.0)]
    goals += [Goal(name, figures[name], most=0) for name in ("late", "lost", "unstored")]
    for name in ("tasks", "connections", "files"):
        first, last = figures[name] = [max(getattr(s, name) for s in part) for part in counts]
        goals.append(Goal(f"growth of the {name}", last - first, most=5))
    rows = {name: {"measured": str(figure)} for name, figure in figures.items()}
    return Report(figures, {"Soak": rows}, goals)


def _fly(
    edge: Server, missions: list[Mission], options: Soak
) -> tuple[list[Sample], tuple[list[Sample], list[Sample]], Counter[str], float]:
    """The samples of the measurement, those before and after the hostile clients, and their ended connections.

    The last value is the number of late decisions since the hostile clients came.
    """
    for mission in missions:
        Radio(edge, 0).create(mission.name, mission.mode)
    guided, others = missions[: options.guided], missions[options.guided :]
    shares = [share for share in (guided, *(others[n::WORKERS] for n in range(WORKERS))) if share]
    workers = [Worker(edge, share, seed) for seed, share in enumerate(shares)]
    for worker in workers:
        worker.start()
    warm = dict(zip(("value", "guided"), options.warm, strict=True))
    _watch(workers, "warming up", 1.0, lambda: min(mission.decisions / warm[mission.mode] for mission in missions))
    for worker in workers:
        worker.pace_s = options.pace_s

    def sampled(label: str, seconds: float) -> list[Sample]:
        began, samples = time.monotonic(), list[Sample]()

        def share() -> float:
            samples.append(sample(edge, began))
            return samples[-1].at_s / seconds

        _watch(workers, label, SAMPLE_S, share)
        return samples

    before = sampled("counting", options.counted_s)
    # The warm-up overloads the edge on purpose, so its late decisions do not count.
    late = metric(edge, "aicvds_deadline_missed_total")
    for mission in missions:
        mission.unstored = 0
    with hostile(edge.url, options.hostile) if options.hostile else nullcontext(Counter[str]()) as ended:
        if options.pace_s:
            sampled("at the pace", options.settle_s)
        for mission in missions:
            mission.sources.clear()
        samples = sampled("measuring", 60 * options.minutes)
    late = metric(edge, "aicvds_deadline_missed_total") - late
    after = sampled("counting again", options.counted_s)
    for worker in workers:
        worker.stopped = True
    for worker in workers:
        worker.join(timeout=60)
    return samples, (before, after), ended, late


def _watch(workers: list[Worker], label: str, pause_s: float, share: Callable[[], float]) -> None:
    """Wait until the completed share is 1; raises ``SystemExit`` if a worker failed."""
    with Progress() as progress:
        task = progress.add_task(label, total=1.0)
        while (done := share()) < 1.0:
            progress.update(task, completed=done)
            if errors := [worker.error for worker in workers if worker.error]:
                raise SystemExit(f"soak: {errors[0]}")
            time.sleep(pause_s)
        progress.update(task, completed=1.0)


if __name__ == "__main__":
    sys.exit(0 if run(Soak, measure) else 1)
