"""A fleet's problems in its reports: overflows by step, and silent sensors."""

import math
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from service.live.alarms import alarms
from service.mission.mission import Mission
from shared.belief.fleet_belief import FleetBelief
from shared.kit.bounded import BoundedDict
from shared.wire.schemas import UavState
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.urgency import overflow_probability

# Most missions watched, and most steps remembered of each.
_MOST_MISSIONS = 1000
_MOST_STEPS = 300
# Seconds without a decision after which a mission has ended early (or six steps), and its UAVs are lost (and three).
_ENDED_S, _SILENT_S = 600.0, 30.0


@dataclass(slots=True)
class Watched:
    """Observations of one mission since the edge started.

    Attributes:
        full: by step, the expected number of sensors that overflowed into it, as the fleet believed at its first
            decision of the step. Sensors of which nothing was ever heard do not count. ``overflows`` sums all steps.
        silent: by sensor, the newest step in which a UAV was within its radio radius and did not hear it.
        decided_at: the monotonic time of the last decision, seconds; None before the first.
        uavs: of each UAV's newest report the monotonic time, s, and its battery, percent, and height, m, if it said so.
        began: the newest step, and the monotonic time of its first report.
        step_took_s: seconds between the first reports of the newest two consecutive steps; None before them.
    """

    full: BoundedDict[int, float] = field(default_factory=lambda: BoundedDict(_MOST_STEPS))
    overflows: float = 0.0
    silent: dict[int, int] = field(default_factory=dict)
    decided_at: float | None = None
    uavs: dict[int, tuple[float, float | None, float | None]] = field(default_factory=dict)
    began: tuple[int, float] = (-2, 0.0)
    step_took_s: float | None = None

    @property
    def batteries(self) -> dict[int, float]:
        """By UAV, percent of its own battery, where that was reported."""
        return {uav: percent for uav, (_, percent, _) in self.uavs.items() if percent is not None}

    def totals(self) -> dict[str, Any]:
        """The page's numbers: sums over the steps, the silent sensors, and the seconds since the last decision."""
        return {
            "overflows": round(self.overflows, 1),
            "silent": self.silent,
            "idle_s": None if self.decided_at is None else round(self.idle_s, 1),
        }

    @property
    def idle_s(self) -> float:
        """Seconds since the last decision; infinite before the first."""
        return math.inf if self.decided_at is None else time.monotonic() - self.decided_at


class FleetWatch:
    """Watches every mission at its decisions; only the event loop uses it."""

    def __init__(self) -> None:
        self._missions = BoundedDict[str, Watched](_MOST_MISSIONS)

    def decided(self, mission: Mission, uav: UavState, step: int) -> None:
        """Record an answered report, and the belief after it."""
        watched = self.of(mission.mission_id)
        now = watched.decided_at = time.monotonic()
        watched.uavs[uav.uav_id] = now, uav.battery_percent, uav.height_m
        if step > watched.began[0]:
            watched.step_took_s = now - watched.began[1] if step == watched.began[0] + 1 else watched.step_took_s
            watched.began = step, now
        if step not in watched.full:
            watched.full[step] = round(float(_overflowed(mission.belief, step, mission.scenario).sum()), 3)
            watched.overflows += watched.full[step]
        self._hear(watched, mission, uav, step)

    def restored(self, mission: Mission) -> None:
        """Record when a mission of the store had its newest decision: its fleet may have been silent ever since."""
        now = time.time()
        if (at := mission.reservations.newest_at(now)) is not None:
            self.of(mission.mission_id).decided_at = time.monotonic() - (now - at)

    def of(self, mission_id: str) -> Watched:
        """The mission's observations."""
        found = self._missions.get(mission_id)
        if found is None:
            found = self._missions[mission_id] = Watched()
        return found

    def alarms(self, missions: Iterable[Mission]) -> Counter[str]:
        """By kind of :mod:`service.live.alarms`, the number of UAVs and sensors of the missions that fly now."""
        counts: Counter[str] = Counter()
        for mission in filter(self._flies, missions):
            counts.update({kind: len(subjects) for kind, subjects in self.alarms_of(mission).items()})
        return counts

    def alarms_of(self, mission: Mission) -> dict[str, dict[int, int | None]]:
        """The alarms of :mod:`service.live.alarms`; of a fleet that has fallen silent all UAVs are lost."""
        watched = self.of(mission.mission_id)
        found = alarms(mission, mission.deadlines(), watched.batteries)
        if self._flies(mission) and watched.idle_s > max(_SILENT_S, 3 * mission.scenario.step_s):
            found["uav_lost"] = dict.fromkeys(mission.belief.uavs)
        return found

    def _flies(self, mission: Mission) -> bool:
        watched, scenario = self._missions.get(mission.mission_id), mission.scenario
        flies = watched is not None and watched.idle_s < max(_ENDED_S, 6 * scenario.step_s)
        return flies and mission.belief.newest != scenario.steps - 1

    def forget(self, mission_id: str) -> None:
        """Forget a deleted mission."""
        self._missions.take(mission_id)

    def _hear(self, watched: Watched, mission: Mission, uav: UavState, step: int) -> None:
        """Note the reported sensors within the UAV's radio radius that it did not hear in this step."""
        columns = uav.sensors
        if watched.silent:
            for sensor, seen in zip(columns.id, columns.last_seen, strict=True):
                if seen == step:
                    watched.silent.pop(sensor, None)
        unheard = np.array([i for i, seen in zip(columns.id, columns.last_seen, strict=True) if seen != step], np.int64)
        if len(unheard):
            offset = mission.belief.places[unheard] - np.array(uav.position)
            near = np.hypot(offset[:, 0], offset[:, 1]) <= mission.scenario.radio_radius_m
            watched.silent.update(dict.fromkeys(unheard[near].tolist(), step))


def _overflowed(belief: FleetBelief, step: int, scenario: Scenario) -> FloatArray:
    """The probability that each queue is full at a step's start, ``P(base + Poisson(rate x steps since) >= W)``.

    It is 0 for sensors of which nothing was ever heard.
    """
    # The arrivals of the steps since, in terms of the function's own horizon.
    arrived = belief.arrivals.rate * np.maximum(step - belief.since, 0) / scenario.overflow_horizon_steps
    # One more packet turns "more than full" into "at least full".
    reached = overflow_probability(belief.base + 1, arrived, scenario)
    return np.where(belief.base_variance > 0, 0.0, np.where(belief.base >= scenario.queue_capacity, 1.0, reached))
