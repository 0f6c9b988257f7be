"""Missions and views for tests of the service's parts."""

from __future__ import annotations

from typing import Any

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.mission.mission import Mission
from service.prompting.rows import ALWAYS_KNOWN, UNKNOWN, row, whole_numbers
from shared.features.augmented_state import State
from shared.wire.schemas import MissionSpec, SensorColumns, UavState
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]


def mission(spec: MissionSpec | None = None, **settings: Any) -> Mission:
    """A mission with the paper's features that decides from its UAVs' own reports, without earlier observations."""
    spec = spec or MissionSpec()
    as_written = {"belief": "reported", "features": spec.features or "paper"}
    return Mission("test", spec.model_copy(update=as_written), Settings(**{"mode": "value", **settings}))


def uav(
    *,
    step: int = 0,
    uav_id: int = 0,
    position: tuple[float, float] = (500.0, 500.0),
    x: list[float] | None = None,
    y: list[float] | None = None,
    queue: list[float | None] | None = None,
    last_seen: list[int | None] | None = None,
) -> UavState:
    """A UAV over the area's centre that hears sensors on a line to the east, 100 m apart, by default."""
    queue = queue if queue is not None else [10.0 * (i + 1) for i in range(6)]
    n = len(queue)
    seen = last_seen if last_seen is not None else [None if q is None else step for q in queue]
    sensors = SensorColumns(
        id=list(range(n)),
        x=x if x is not None else [500.0 + 100.0 * i for i in range(n)],
        y=y or [500.0] * n,
        queue=queue,
        battery=[None if q is None else 50.0 for q in queue],
        channel_gain=[None if q is None else -90.0 for q in queue],
        last_seen=seen,
    )
    return UavState(uav_id=uav_id, position=list(position), sensors=sensors)


def attended(mission: Mission, state: UavState, step: int = 0) -> AttendedState:
    return AttendedState.of(mission, state, step)


def written_rows(state: State) -> list[str]:
    """The prompt line of every sensor; without a beacon its reported numbers are unknown."""
    names, numbers = whole_numbers(state)
    return [
        row({n: str(v) if heard or n in ALWAYS_KNOWN else UNKNOWN for n, v in zip(names, values, strict=True)})
        for values, heard in zip(numbers.T.tolist(), state.heard.tolist(), strict=True)
    ]
