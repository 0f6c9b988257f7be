"""The data and the script of the report's playback."""

from __future__ import annotations

import base64
import hashlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.records.decision import Decision
from simulator.records.track import Instant

# Points of all the drawn trajectories; one circle has at most 121.
_POINTS, _POINTS_EACH = 3_000, 121


@dataclass(frozen=True)
class Playback:
    """What the page embeds: the mission as JSON's types, and the script that shows every ``stride``-th step of it."""

    mission: dict[str, Any]
    stride: int
    script: str

    @property
    def script_source(self) -> str:
        """The script's source expression for a Content-Security-Policy."""
        digest = hashlib.sha256(self.script.encode("utf-8")).digest()
        return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def playback(
    scenario: Scenario,
    sensor_xy: np.ndarray,
    decisions: Iterable[Decision],
    instants: Sequence[Instant],
    stride: int,
) -> Playback | None:
    """The playback of a mission; ``None`` where no step was flown.

    Args:
        scenario: of the mission, for the map, the queues' capacity and the batteries.
        sensor_xy: (J, 2), metres.
        decisions: of the steps flown.
        instants: every ``stride``-th of the mission and the last, the start first.
        stride: 1 where no instant is left out.
    """
    if len(instants) < 2:
        return None
    shown = {instant.step for instant in instants}
    by_step: dict[int, list[list[Any]]] = defaultdict(list)
    for d in decisions:
        if d.step in shown:
            outcome = (int(d.failed), d.collected, d.lost_packets, round(d.cost, 3))
            by_step[d.step].append([d.uav_id, d.sensor_id, d.velocity, d.source, *outcome])
    each = max(2, min(_POINTS_EACH, _POINTS // scenario.uavs))
    mission = {
        "steps": scenario.steps,
        "capacity": scenario.queue_capacity,
        "area": scenario.area_m,
        "sensors": _rounded(sensor_xy),
        "pipeline": _rounded(scenario.pipeline) if scenario.layout != "uniform" else [],
        "trajectories": [_rounded(path.at(np.linspace(0.0, path.length_m, each))) for path in trajectories(scenario)],
        "frames": [_frame(one, by_step[one.step], scenario.battery_j) for one in instants],
    }
    script = files("simulator.reporting").joinpath("playback.js").read_text(encoding="utf-8")
    return Playback(mission, stride, script)


def _frame(instant: Instant, decisions: list[list[Any]], battery_j: float) -> dict[str, Any]:
    return {
        "step": instant.step,
        "uavs": [[uav, round(x, 1), round(y, 1)] for uav, (x, y) in sorted(instant.positions.items())],
        "queue": instant.queue.tolist(),
        "battery": np.ceil(100 * instant.battery / battery_j).astype(int).tolist(),
        "lost": instant.lost.tolist(),
        "decisions": decisions,
    }


def _rounded(points: Any) -> list[list[float]]:
    return [[round(x, 1), round(y, 1)] for x, y in np.asarray(points, dtype=float).reshape(-1, 2).tolist()]
