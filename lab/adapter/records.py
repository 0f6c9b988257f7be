"""The planner's decisions as arrays, from which prompts of any number of rows are made: one file of a few megabytes.

    python -m lab.adapter.records runs/rollouts/*.jsonl.gz --out runs/records

Each recording of ``python -m lab explore --teacher planner`` becomes one ``.npz`` file. With ``--merge`` they become
one:

    python -m lab.adapter.records --merge runs/records/*.npz --out lab/adapter/decisions.npz

Its arrays, of N decisions and the ten sensors that attention scores highest:

- ``fleet`` (N, 6): the digits before ``U`` of the compact prompt.
- ``rows`` (N, 10, 6): each sensor's digits, ``ids`` (N, 10) its ID; -1 after the ``n`` (N,) sensors that there are.
- ``vel`` (N, 10, 6): velocities, m/s: four options evenly spaced over those that move nearly the most packets, the
  middle one of three, and the one of most worth. So every number of options that a prompt has is among them.
- ``lost`` (N, 10, 6): the packets that the rollout evaluator expects the fleet to lose after each of these.
- ``ref``, ``refv`` (N,): the planner's sensor, by its place (-1: another one), and its velocity.
- ``failing`` (N, 10): whether the sensor's newest experience is a failure; ``blocks`` (N,): the experiences' text.
- ``mission`` (N,): the number of the training world; ``scenario`` (N,): its name. Each eleventh world is held out.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from lab.distilling.examples import failing_signs, missions_of
from lab.exploration.rollouts import Header, Reference, RolloutStep, read_rollouts
from lab.training.recorded_states import recorded_states
from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState
from service.mission.mission import Mission
from service.prompting.candidates import Viewpoint, velocity_options
from service.prompting.compact_prompt import Outlook, fleet_digits, row_digits, sign
from shared.wire.schemas import MissionSpec
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

ROWS, OPTIONS = 10, 6
# Belief and experiences of a recording's missions, in turn; most have a learned belief, as by default.
_VIEWS = [("fleet", 0)] * 7 + [("reported", 8), ("fleet", 8), ("reported", 0)]
_NEVER = 1e4

Record = dict[str, Any]


def records_of(recording: Path) -> dict[str, np.ndarray]:
    """The arrays of one recording."""
    header, steps = read_rollouts(recording)
    found = [
        record
        for number, logged in enumerate(missions_of(steps))
        for record in _mission_records(header, number, logged)
    ]
    return {name: np.array([record[name] for record in found]) for name in found[0]}


def mission_of(scenario: Scenario, mission_id: str, seed: int, view: int) -> Mission:
    """A mission whose states are recorded, in the view of that number."""
    belief, experiences = _VIEWS[view % len(_VIEWS)]
    spec = {
        "scenario": scenario,
        "planner": "off",
        "features": "reach",
        "belief": belief,
        "top_k": 2 * ROWS,
        "prompt": {"format": "compact", "order": "score", "experiences": experiences},
        "seed": seed,
    }
    settings = Settings(mode="guided", store="none", llm_adapter="served")
    return Mission(mission_id, MissionSpec.model_validate(spec), settings)


def _mission_records(header: Header, number: int, logged: list[RolloutStep]) -> list[Record]:
    mission_id = logged[0].request.mission_id
    seed = int(mission_id.rpartition("-")[2])
    mission = mission_of(header.scenario, mission_id, seed, number + seed)
    return [
        record_of(state, step.reference)
        for step, state in recorded_states(mission, logged)
        if step.reference is not None and state.rows
    ]


def record_of(state: AttendedState, reference: Reference) -> Record:
    """The record of a decision in a state that has candidates."""
    mission, scenario, rows = state.mission, state.mission.scenario, state.rows[:ROWS]
    view = Viewpoint(mission.belief, state.uav_id, state.step, learned=mission.belief_source == "fleet")
    outlook, reach = Outlook.of(view, scenario), state.reach
    velocities = [
        [*velocity_options(reach, row, 4), velocity_options(reach, row, 3)[1], int(reach.best[row])] for row in rows
    ]
    ids = state.state.ids[rows]
    actions = [Action(int(sensor), v) for sensor, own in zip(ids, velocities, strict=True) for v in own]
    start = RolloutState.of(
        mission.belief, scenario, state.step, state.uav_id, seed=mission.spec.seed, reserved=state.reserved
    )
    different = list(dict.fromkeys(actions))
    lost = dict(zip(different, evaluate(start, different).lost, strict=True))
    block = mission.experiences.block
    failing = failing_signs(block)
    where = np.flatnonzero(ids == reference.sensor_id)
    return {
        "fleet": np.array([int(digit) for digit in fleet_digits(state.state, outlook, state.step, scenario)], np.int8),
        "rows": _padded(row_digits(state.state, reach, outlook, scenario)[rows], (ROWS, 6), np.int8),
        "ids": _padded(ids, (ROWS,), np.int16, -1),
        "vel": _padded(velocities, (ROWS, OPTIONS), np.int8),
        "lost": _padded(np.reshape([lost[a] for a in actions], (-1, OPTIONS)), (ROWS, OPTIONS), np.float32, _NEVER),
        "n": np.int8(len(rows)),
        "ref": np.int8(where[0] if len(where) else -1),
        "refv": np.int8(reference.velocity),
        "failing": _padded([sign(int(sensor)) in failing for sensor in ids], (ROWS,), np.int8),
        "blocks": "".join(block) if mission.spec.prompt.experiences else "",
        "mission": mission.spec.seed,
        "scenario": scenario.name,
    }


def _padded(values: Any, shape: tuple[int, ...], kind: Any, filled: float = 0) -> np.ndarray:
    padded = np.full(shape, filled, dtype=kind)
    padded[: len(values)] = values
    return padded


def main() -> None:
    """Make the records of recordings, or one file of several."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--merge", action="store_true")
    args = parser.parse_args()
    if args.merge:
        parts = [np.load(file) for file in args.files]
        np.savez_compressed(args.out, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
        return
    args.out.mkdir(parents=True, exist_ok=True)
    for file in args.files:
        np.savez_compressed(args.out / f"{file.name.partition('.')[0]}.npz", **records_of(file))


if __name__ == "__main__":
    main()
