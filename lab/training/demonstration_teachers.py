"""The teachers' answers to recorded decisions, and a diverse selection of them, for ``python -m lab demonstrate``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from itertools import groupby

import numpy as np

from lab.exploration.rollouts import Header, RolloutStep
from lab.training.recorded_states import recorded_states
from service.config.settings import Settings
from service.deciding.advisers import look_ahead
from service.mission.mission import Mission
from service.prompting.demonstrations import Demonstration
from shared.features.augmented_state import State
from shared.wire.schemas import MissionSpec, UavState
from shared.world.actions import Action
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario

# A function of a recorded decision, the edge's state, the scenario and the reserved sensors. It returns an action, or
# None where the teacher has no answer.
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
    """The teacher's answer to each decision with several admissible sensors, with the decision's :func:`point`.

    A decision is left out where the teacher has no answer, or where its answer collects nothing as far as the UAV knows
    and its sensor is therefore arbitrary. Visiting records, arrival rates and reservations are the recorded flight's.
    """
    settings = Settings(mode="value")
    spec = MissionSpec(scenario=header.scenario, features="reach", belief="reported", planner="off", init="random")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        mission = Mission(mission_id, spec, settings)
        for step, state in recorded_states(mission, group):
            if state.state.admissible.sum() <= 1:
                continue
            answer = teacher(step, state.state, mission.scenario, state.reserved)
            if answer is not None and _collects(state.state, *answer):
                demonstration = _demonstration(mission, step.request, state.step, answer)
                yield demonstration, point(state.state, *answer, mission.scenario)


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
    """Integers unchanged, other numbers to a tenth."""
    return round(value, 1) if isinstance(value, float) else value


def point(state: State, sensor_id: int, velocity: int, scenario: Scenario) -> FloatArray:
    """A decision as a point, ``(3 d + 1,)``; similar decisions are near each other.

    The point has the chosen sensor's features, the mean and the maximum of the features over the admissible sensors,
    and the velocity, each 0..1.
    """
    features = state.features(scenario)
    chosen = features[int(np.flatnonzero(state.ids[state.admissible] == sensor_id)[0])]
    level = [velocity / scenario.max_velocity]
    return np.concatenate((chosen, features.mean(axis=0), features.max(axis=0), level)).astype(np.float64)


def farthest_first(points: FloatArray, count: int) -> list[int]:
    """Indices of ``count`` of the points ``(n, d)``; the point nearest to the mean comes first.

    Each next point is the farthest from those before it: the greedy k-center of Gonzalez, Theoretical Computer
    Science 38 (1985), whose every prefix covers the points within twice the least radius possible.
    """
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
