"""``aicvds demonstrate``: choose worked examples for the prompt from recorded rollouts, each solved by a teacher."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from tyro.conf import arg

from service.demonstrations import Demonstration, Demonstrations
from service.features import State
from service.mission import Mission
from service.policy import decide_without_llm
from service.settings import Settings
from service.view import View
from shared.channel import FloatArray
from shared.rollouts import Header, RolloutStep, read_rollouts
from shared.scenario import Scenario
from shared.wire import MissionSpec, Outcome, UavState

# Given a recorded decision, the state as the edge saw it, the scenario and the sensors that are taken: a sensor and a
# velocity, or None where it has no answer.
Teacher = Callable[[RolloutStep, State, Scenario, Collection[int]], tuple[int, int] | None]


def _look_ahead(
    step: RolloutStep, state: State, scenario: Scenario, reserved: Collection[int]
) -> tuple[int, int] | None:
    return decide_without_llm(state, step.request.uav_id, scenario, reserved)


def _recorded(
    name: str, step: RolloutStep, state: State, scenario: Scenario, reserved: Collection[int]
) -> tuple[int, int] | None:
    reference = step.reference
    return (reference.sensor_id, reference.velocity) if reference and reference.teacher == name else None


TEACHERS: dict[str, Teacher] = {
    "planner": partial(_recorded, "planner"),
    "clairvoyant": partial(_recorded, "clairvoyant"),
    "look_ahead": _look_ahead,
}


@dataclass(frozen=True)
class Demonstrate:
    """Choose the worked examples that a prompt may show (prompt.demonstrations), and write them as JSON.

    Record first:  aicvds explore --workers 2 --out runs/rollouts.jsonl.gz

    Then:  aicvds demonstrate runs/rollouts.jsonl.gz --out service/checkpoints/demonstrations.json

    Every recorded decision with a choice of sensors and something in reach is answered by the teacher. The one in the
    middle of all states comes first, then each time the one farthest from those chosen: so the first few differ most.
    """

    rollouts: Annotated[tyro.conf.Positional[Path], arg(metavar="FILE")]
    """What `aicvds explore` wrote."""
    out: Annotated[Path, arg(metavar="FILE")]
    """JSON file to write. The package's own is service/checkpoints/demonstrations.json."""
    count: Annotated[int, arg(metavar="N")] = 40
    """Decisions to choose. A mission shows 20 at most, and leaves out those whose answer it could not give."""
    teacher: Annotated[str, arg(metavar="NAME")] = "planner"
    """Whose answers they show: planner or clairvoyant, as `aicvds explore` recorded them, or look_ahead, one step of
    look-ahead. A clairvoyant acts on arrivals that nobody who reads the prompt can know."""


def main(argv: list[str]) -> int:
    """Choose and write; returns the exit code."""
    args = tyro.cli(Demonstrate, prog="aicvds demonstrate", args=argv)
    try:
        if args.teacher not in TEACHERS:
            raise ValueError(f"--teacher {args.teacher}: choose one of {', '.join(TEACHERS)}")
        if args.count < 1:
            raise ValueError(f"--count {args.count} is not at least 1")
        header, steps = read_rollouts(args.rollouts)
        total = header.missions * header.scenario.steps * header.scenario.uavs
        told = track(steps, total=total, description="Solving", console=Console(stderr=True))
        demonstrations, states = [], []
        for demonstration, state in solutions(header, told, TEACHERS[args.teacher]):
            demonstrations.append(demonstration)
            states.append(state)
        if not states:
            fix = "record with aicvds explore --teacher both"
            raise ValueError(f"{args.rollouts} holds no decision of {args.teacher}: {fix}")
        if len(states) < args.count:
            raise ValueError(f"{args.rollouts} holds {len(states)} decisions with a choice; --count asks {args.count}")
        chosen = [demonstrations[i] for i in farthest_first(np.stack(states), args.count)]
        args.out.parent.mkdir(parents=True, exist_ok=True)
        pool = Demonstrations(scenario=header.scenario, teacher=args.teacher, demonstrations=chosen)
        args.out.write_text(pool.model_dump_json(exclude_defaults=True) + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        print(f"aicvds demonstrate: {error}", file=sys.stderr)
        return 2
    print(f"Wrote {args.out}: {args.count} of {len(states)} decisions, {args.out.stat().st_size} bytes")
    return 0


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
            view = View.of(mission, uav, uav.step)
            if view.state.admissible.sum() > 1:
                reserved = mission.reserved(uav.step, uav.uav_id)
                answer = teacher(step, view.state, mission.scenario, reserved)
                if answer is not None and _collects(view.state, *answer):
                    demonstration = _demonstration(mission, uav, uav.step, answer)
                    yield demonstration, likeness(view.state, *answer, mission.scenario)
            mission.commit(view.pending(mission, decision_id, step.sensor_id, step.velocity))
            mission.apply(Outcome(decision_id=decision_id, cost=step.cost, failed=step.failed))


def _collects(state: State, sensor_id: int, velocity: int) -> bool:
    assert state.reach is not None
    row = np.flatnonzero(state.ids == sensor_id)[0]
    return bool(state.admissible[row] and state.reach.packets[velocity, row] >= 1)


def _demonstration(mission: Mission, uav: UavState, step: int, answer: tuple[int, int]) -> Demonstration:
    columns = uav.sensors.model_dump()
    rounded = {name: [_rounded(value) for value in values] for name, values in columns.items()}
    report = {"uav_id": uav.uav_id, "position": [_rounded(x) for x in uav.position]}
    return Demonstration.model_validate(
        {
            "uav": {**report, "progress_m": _rounded(uav.progress_m), "sensors": rounded},
            "step": step,
            "visits": mission.visits.tolist(),
            "rates": [round(rate, 2) for rate in mission.rates.tolist()],
            "reserved": sorted(mission.reserved(step, uav.uav_id)),
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
