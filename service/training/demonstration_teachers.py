"""Recorded decisions as a teacher solves them, and which of them differ most: for ``aicvds demonstrate``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from itertools import groupby

import numpy as np

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.look_ahead import look_ahead
from service.mission.mission import Mission
from service.prompting.demonstrations import Demonstration
from shared.actions import Action
from shared.channel import FloatArray
from shared.features import State
from shared.rollouts import Header, RolloutStep
from shared.scenario import Scenario
from shared.wire import MissionSpec, Outcome, UavState

# Given a recorded decision, the state as the edge saw it, the scenario and the sensors that are taken: a sensor and a
# velocity, or None where it has no answer.
Teacher = Callable[[RolloutStep, State, Scenario, Collection[int]], Action | None]


def _look_ahead(step: RolloutStep, state: State, scenario: Scenario, reserved: Collection[int]) -> Action | None:
    return look_ahead(state, state.reach_ahead(step.request.uav_id, scenario), reserved)


def _recorded(
    name: str, step: RolloutStep, state: State, scenario: Scenario, reserved: Collection[int]
) -> Action | None:
    reference = step.reference
    return Action(reference.sensor_id, reference.velocity) if reference and reference.teacher == name else None


TEACHERS: dict[str, Teacher] = {
    "planner": partial(_recorded, "planner"),
    "clairvoyant": partial(_recorded, "clairvoyant"),
    "look_ahead": _look_ahead,
}


def solutions(
    header: Header, steps: Iterable[RolloutStep], teacher: Teacher
) -> Iterator[tuple[Demonstration, FloatArray]]:
    """Each decision with a choice of sensors as the teacher solves it, and what it is like (:func:`likeness`).

    Where the teacher has no answer, or collects nothing as far as the UAV knows, so that its sensor means nothing, the
    decision is left out. Visiting records, arrival rates and reservations are those of the flight that was recorded.
    """
    settings = Settings(mode="value")
    spec = MissionSpec(scenario=header.scenario, features="reach", belief="reported", planner="off", init="random")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        mission = Mission(mission_id, spec, settings)
        for number, step in enumerate(group):
            uav, decision_id = step.request, f"{number:032x}"
            mission.observe(uav, uav.step)
            view = AttendedState.of(mission, uav, uav.step)
            if view.state.admissible.sum() > 1:
                reserved = mission.reservations.of_others(uav.step, uav.uav_id)
                answer = teacher(step, view.state, mission.scenario, reserved)
                if answer is not None and _collects(view.state, *answer):
                    demonstration = _demonstration(mission, uav, uav.step, answer)
                    yield demonstration, likeness(view.state, *answer, mission.scenario)
            mission.commit(view.pending(decision_id, Action(step.sensor_id, step.velocity)))
            mission.apply(Outcome(decision_id=decision_id, cost=step.cost, failed=step.failed))


def _collects(state: State, sensor_id: int, velocity: int) -> bool:
    assert state.reach is not None
    row = np.flatnonzero(state.ids == sensor_id)[0]
    return bool(state.admissible[row] and state.reach.packets[velocity, row] >= 1)


def _demonstration(mission: Mission, uav: UavState, step: int, answer: Action) -> Demonstration:
    columns = uav.sensors.model_dump()
    rounded = {name: [_rounded(value) for value in values] for name, values in columns.items()}
    report = {"uav_id": uav.uav_id, "position": [_rounded(x) for x in uav.position]}
    return Demonstration.model_validate(
        {
            "uav": {**report, "progress_m": _rounded(uav.progress_m), "sensors": rounded},
            "step": step,
            "visits": mission.records.visits.tolist(),
            "rates": [round(rate, 2) for rate in mission.records.rates.tolist()],
            "reserved": sorted(mission.reservations.of_others(step, uav.uav_id)),
            "sensor_id": answer[0],
            "velocity": answer[1],
        }
    )


def _rounded(value: float | None) -> float | None:
    """Whole steps, packets and IDs as they are, the rest to a tenth."""
    return round(value, 1) if isinstance(value, float) else value


def likeness(state: State, sensor_id: int, velocity: int, scenario: Scenario) -> FloatArray:
    """A decision as a point: states that ask for the same lie near each other.

    The features of the sensor decided for, their mean and their greatest over the admissible sensors, and the velocity,
    each 0..1: ``(3 d + 1,)``.
    """
    features = state.features(scenario)
    chosen = features[int(np.flatnonzero(state.ids[state.admissible] == sensor_id)[0])]
    level = [velocity / scenario.max_velocity]
    return np.concatenate((chosen, features.mean(axis=0), features.max(axis=0), level)).astype(np.float64)


def farthest_first(points: FloatArray, count: int) -> list[int]:
    """Indices of ``count`` of the points ``(n, d)``, the one nearest to their mean first.

    Each next one is the farthest from those before it: the greedy k-center of Gonzalez, Theoretical Computer Science 38
    (1985), whose every prefix covers the points within twice the least radius possible.
    """
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
