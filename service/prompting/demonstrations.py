"""Worked examples for the static block: decisions of training worlds, each with a teacher's answer.

The file has the edge's knowledge at each decision, not text. So one file serves every prompt format, feature preset and
k: a mission shows each example in the format of its own rows. ``python -m lab demonstrate`` makes the file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from service.learning.modules import Weights, top_k
from service.prompting.rows import Cells, cells
from shared.features.augmented_state import State, augment
from shared.wire.schemas import Features, MissionSpec, SensorId, Step, UavState
from shared.wire.strict_models import Wire
from shared.world.scenario import Scenario

PACKAGED = "demonstrations.json"


class Demonstration(Wire):
    """One decision: the UAV's report, its mission's knowledge, and the teacher's answer.

    ``visits`` is the step of each sensor's last visit, -1 for never; ``rates`` packets a step; both by sensor ID.
    """

    uav: UavState
    step: Step
    visits: list[int]
    rates: list[float]
    reserved: list[SensorId]
    sensor_id: SensorId
    velocity: int

    def state(self, scenario: Scenario, preset: Features) -> State:
        """The augmented state at the decision."""
        return augment(
            self.uav,
            self.step,
            scenario,
            visits=np.array(self.visits, dtype=np.int64),
            rates=np.array(self.rates),
            reserved=self.reserved,
            preset=preset,
        )


class Demonstrations(Wire):
    """The file: the world of all demonstrations, the teacher's name, and the demonstrations, the most useful first."""

    scenario: Scenario
    teacher: str
    demonstrations: list[Demonstration]


@dataclass(frozen=True, slots=True)
class Solved:
    """A demonstration in a prompt: its rows and the teacher's answer."""

    rows: Sequence[Cells]
    sensor_id: int
    velocity: int


def solved(spec: MissionSpec, features: Features, scenario: Scenario, weights: Weights, k: int | None) -> list[Solved]:
    """The demonstrations that the mission's spec asks for, with the rows that the mission would show, in its order.

    A demonstration is left out where the mission could not give its answer: the modules do not keep the sensor among
    the k, or the velocity exceeds the mission's limit. So there are fewer where k is small or the modules are random.

    Args:
        features: the preset of the mission's modules.
        scenario: the mission's world.
        weights: the modules' weights.
        k: rows to keep of each; None keeps every admissible row, in the request's order.
    """
    found: list[Solved] = []
    if spec.prompt.demonstrations == 0:
        return found
    pool = packaged()
    for number, demonstration in enumerate(pool.demonstrations):
        state = demonstration.state(pool.scenario, features)
        rows = np.flatnonzero(state.admissible)
        if k is not None:
            rows = rows[top_k(weights.attend(state.features(pool.scenario)).scores, k)]
        if spec.prompt.order == "shuffled":
            rows = np.random.default_rng([spec.seed, number]).permutation(rows)
        if demonstration.sensor_id in state.ids[rows] and demonstration.velocity <= scenario.max_velocity:
            shown = cells(state, rows)
            found.append(Solved(shown, demonstration.sensor_id, demonstration.velocity))
        if len(found) == spec.prompt.demonstrations:
            break
    return found


@cache
def packaged() -> Demonstrations:
    """The demonstrations that ship with the package."""
    return Demonstrations.model_validate_json(files("service").joinpath("checkpoints", PACKAGED).read_bytes())
