"""Record decisions in the states that the adapted LLM's own decisions lead to (DAgger, Ross et al. 2011).

    python -m lab.adapter.student_flights --scenario paper --first 60000 --missions 32 --base runs/base \
        --adapter runs/adapter/adapter.npz --out runs/own/paper.npz

The UAVs fly the likeliest answer of the LLM, for whose prompts k is 3, 5, 7 or 10 by mission. The planner's action and
the rollout evaluator's losses in each of its states are recorded as :mod:`lab.adapter.records` says. The missions fly
concurrently, so that one batch has a prompt of each.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from lab.adapter.batches import PromptTokens, RecordTensors
from lab.adapter.model import Model
from lab.adapter.records import Record, mission_of, record_of
from lab.exploration.rollouts import Reference
from lab.exploration.teachers import PlannerTeacher
from lab.training_seeds import FIRST_TRAINING_SEED
from service.deciding.attended_state import AttendedState
from shared.wire.schemas import Outcome
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.step_rule import Action
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request

_ROWS = (5, 3, 5, 7, 5, 10)

# A generator that yields each record of a mission, and receives the action to fly.
_Flight = Generator[Record, Action, None]


class Answers(Protocol):
    """Answers to the prompts of records."""

    def of(self, records: Sequence[Record], k: int) -> list[Action]:
        """The actions for records that have at least two candidates each, in prompts of at most k rows."""


class StudentAnswers:
    """The likeliest answers of the LLM with an adapter to the prompts of records."""

    def __init__(self, base: Path, adapter: Path) -> None:
        self._model, self._tokens = Model.of(base, "cpu"), PromptTokens(base / "tokens.json", "cpu")
        self._model.load_adapter(np.load(adapter))
        self._layers = self._model.layers()
        self._drawn = torch.Generator().manual_seed(0)

    @torch.no_grad()
    def of(self, records: Sequence[Record], k: int) -> list[Action]:
        """The likeliest answers."""
        tensors = RecordTensors({name: np.array([one[name] for one in records]) for name in records[0]}, self._tokens)
        chosen: dict[int, Action] = {}
        numbers = torch.arange(len(records))
        for experiences in tensors.experiences.unique().tolist():
            for rows, which in tensors.shown(numbers[tensors.experiences == experiences], k).items():
                batch = tensors.batch(which, k, rows, experiences, self._drawn)
                states = self._model(batch.tokens, self._layers)[:, -1]
                answers = self._model.logits(states, self._tokens.letters[: batch.velocities[0].numel()]).argmax(1)
                row = answers // batch.velocities.shape[2]
                places = batch.sensors.gather(1, row[:, None])[:, 0]
                velocities = batch.velocities.flatten(1).gather(1, answers[:, None])[:, 0]
                for number, place, velocity in zip(which.tolist(), places.tolist(), velocities.tolist(), strict=True):
                    chosen[number] = Action(int(records[number]["ids"][place]), velocity)
        return [chosen[number] for number in range(len(records))]


def flight_of(scenario: Scenario, number: int) -> _Flight:
    """One mission in training world ``number``; where there is no choice, the planner's action is flown."""
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=FIRST_TRAINING_SEED + number)
    teacher = PlannerTeacher(world)
    name = f"own-{number}"
    mission = mission_of(scenario, name, number, number)
    outcomes: dict[int, Outcome] = {}
    for step in range(scenario.steps):
        choices: dict[int, Action] = {}
        for agent, uav in world.live.items():
            observation, taken = observations[agent], frozenset(sensor for sensor, _ in choices.values())
            advised = Action(*teacher.decide(uav, observation, taken))
            if uav in outcomes:
                mission.apply(outcomes.pop(uav))
            request = decide_request(uav, observation, name)
            mission.observe(request, step)
            state = AttendedState.of(mission, request, step)
            action = advised
            if len(state.rows) > 1:
                reference = Reference(teacher="planner", sensor_id=advised.sensor_id, velocity=advised.velocity)
                action = yield record_of(state, reference)
            mission.commit(state.pending(f"{step:016x}{uav:016x}", action))
            teacher.flown(uav, step, action)
            choices[uav] = action
        observations, _, _, _, infos = world.step({f"uav_{u}": np.array(c) for u, c in choices.items()})
        for uav in choices:
            cost, failed = float(infos[f"uav_{uav}"]["cost"]), bool(infos[f"uav_{uav}"]["failed"])
            outcomes[uav] = Outcome(decision_id=f"{step:016x}{uav:016x}", cost=cost, failed=failed)
            teacher.learn(uav, step, failed)


def records_of_flights(scenario: Scenario, missions: Sequence[int], answers: Answers) -> list[Record]:
    """Fly the missions concurrently; returns the records of their decisions."""
    records: list[Record] = []
    flights = {number: flight_of(scenario, number) for number in missions}
    waiting = {number: next(flight) for number, flight in flights.items()}
    while waiting:
        records += waiting.values()
        now: dict[int, Record] = {}
        for k in sorted(set(_ROWS)):
            own = [number for number in waiting if _ROWS[number % len(_ROWS)] == k]
            actions = answers.of([waiting[number] for number in own], k) if own else []
            for number, action in zip(own, actions, strict=True):
                following = next_of(flights[number], action)
                if following is not None:
                    now[number] = following
        waiting = now
    return records


def next_of(flight: _Flight, action: Action) -> Record | None:
    """The flight's next record; None where it has ended."""
    try:
        return flight.send(action)
    except StopIteration:
        return None


def main() -> None:
    """Fly and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", required=True, choices=sorted(SCENARIOS))
    parser.add_argument("--first", type=int, required=True, help="the number of the first training world")
    parser.add_argument("--missions", type=int, required=True)
    parser.add_argument("--base", required=True, type=Path)
    parser.add_argument("--adapter", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    answers = StudentAnswers(args.base, args.adapter)
    records = records_of_flights(SCENARIOS[args.scenario], range(args.first, args.first + args.missions), answers)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out, **{name: np.array([one[name] for one in records]) for name in records[0]})
    print(f"{len(records)} decisions of {args.missions} missions", file=sys.stderr)


if __name__ == "__main__":
    main()
